"""What the host counts: over a whole run, and from one line of metrics to the next."""

from collections import Counter
from dataclasses import asdict, dataclass, field
from typing import Any

from cassie_mjx.ppo.types import UpdateMetrics

NOT_MEASURED = -1.0


@dataclass
class Counters:
    """What the host counts over a whole run, resumed or not."""

    train_s: float = 0.0
    """Time in training, evaluations apart, s."""
    return_plain: float = NOT_MEASURED
    """`return_plain` of the best policy so far: best by the reward that is learned from."""
    return_weighted: float = NOT_MEASURED
    """`return_weighted` of the same policy."""
    walked: float = NOT_MEASURED
    """Control steps that the last policy measured has walked, mean over the starts."""
    measurements: float = 0
    """Policies whose return was measured."""


@dataclass
class IntervalStats:
    """What the host counts from one line of metrics to the next."""

    train_s: float = 0.0
    """Time in training, s."""
    iterations: int = 0
    ends: Counter[str] = field(default_factory=Counter)
    """Episodes that ended by each of `termination.Ends`."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Time by the part of the program it was spent in, s."""


def episode_steps(update: UpdateMetrics, longest: int) -> float:
    """Mean length of an episode, control steps per end; the longest there is if none ended."""
    return 1 / max(float(update.terminated + update.truncated), 1 / longest)


def to_record(counters: Counters, interval: IntervalStats) -> dict[str, Any]:
    """Both as JSON can hold them."""
    # `asdict` would make a Counter of pairs, and count these.
    return {"counters": asdict(counters), "interval": vars(interval) | {"ends": dict(interval.ends)}}


def from_record(record: dict[str, Any]) -> tuple[Counters, IntervalStats]:
    """What `to_record` was given; an interval of nothing from a record of before there were any.

    Raises:
      ValueError: a count is missing, unknown or no number.
    """
    try:
        counters = Counters(**_numbers(record["counters"]))
        held = dict(record.get("interval", {}))
        ends, seconds = _numbers(held.pop("ends", {})), _numbers(held.pop("seconds", {}))
        train_s, iterations = float(held.get("train_s", 0)), int(held.get("iterations", 0))
        whole = Counter({name: int(count) for name, count in ends.items()})
        interval = IntervalStats(train_s, iterations, whole, seconds)
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"its counts of a run cannot be read ({type(error).__name__}: {error}).") from error
    return counters, interval


def _numbers(values: dict[str, Any]) -> dict[str, float]:
    return {name: float(value) for name, value in values.items()}
