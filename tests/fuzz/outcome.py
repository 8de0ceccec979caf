"""What may come of one attempt, and how an attempt in this process is judged."""

import signal
import traceback
from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

HANG_S = 20
REFUSED, SAME, DIFFERENT, TRACEBACK, HANG, LOST = "refused", "same", "different", "traceback", "hang", "lost"
FAULTS = (DIFFERENT, TRACEBACK, HANG, LOST)
"""Silent differences, tracebacks, hangs and lost results: none may happen."""


class Outcome(NamedTuple):
    """What came of one attempt."""

    kind: str
    attempt: str
    detail: str = ""


def tried(attempt: str, call: Callable[[], Any], equal: Callable[[Any], bool]) -> Outcome:
    """Call, and say whether it refused in one sentence, or returned what `equal` takes for the right value."""

    def overdue(*_: Any) -> None:
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, overdue)
    signal.alarm(HANG_S)
    try:
        kind, detail = (SAME, "") if equal(call()) else (DIFFERENT, "it was taken, with another content")
    except TimeoutError:
        kind, detail = HANG, f"longer than {HANG_S} s"
    except (ValueError, OSError) as error:
        kind, detail = (REFUSED, str(error)) if one_sentence(str(error)) else (TRACEBACK, repr(error))
    except BaseException:
        kind, detail = TRACEBACK, traceback.format_exc()
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
    return Outcome(kind, attempt, detail)


def one_sentence(text: str) -> bool:
    """Whether a message is for people: not empty, on one line."""
    return bool(text.strip()) and len(text.strip().splitlines()) == 1


def summary(outcomes: list[Outcome]) -> str:
    """Counts of all kinds, and the first faults of each kind in full."""
    counts = Counter(outcome.kind for outcome in outcomes)
    lines = [f"{len(outcomes)} attempts: " + ", ".join(f"{counts[kind]} {kind}" for kind in (REFUSED, SAME, *FAULTS))]
    for kind in FAULTS:
        faults = [outcome for outcome in outcomes if outcome.kind == kind]
        lines += [f"{kind}: {outcome.attempt}: {outcome.detail}" for outcome in faults[:5]]
    return "\n".join(lines)
