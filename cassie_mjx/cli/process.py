"""What a command does with the terminal, with warnings and with signals."""

import signal
import sys
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from rich.console import Console


def console() -> Console:
    """Where a command speaks: on stderr, and to the letter, for names of files may look like markup."""
    return Console(stderr=True, markup=False, emoji=False, highlight=False)


@contextmanager
def as_command() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the block as Ctrl-C does, so that nothing half done is left, and warn in sentences."""
    shown, warnings.formatwarning = warnings.formatwarning, _sentence
    # Python handles signals in its main thread alone; who ignores one, as nohup does, goes on doing so.
    main = threading.current_thread() is threading.main_thread()
    ending = [each for each in (signal.SIGTERM, signal.SIGHUP) if main and signal.getsignal(each) == signal.SIG_DFL]
    for number in ending:
        signal.signal(number, _leave)
    try:
        yield
    finally:
        for number in ending:
            signal.signal(number, signal.SIG_DFL)
        warnings.formatwarning = shown


def _leave(number: int, _: FrameType | None) -> None:
    sys.exit(128 + number)


def _sentence(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None
) -> str:
    if category is UserWarning:
        return f"warning: {message}\n"
    return _formatted(message, category, filename, lineno, line)


_formatted = warnings.formatwarning
