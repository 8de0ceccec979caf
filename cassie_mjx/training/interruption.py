"""A signal that asks a run to stop: it is noted, and the run ends after its present iteration."""

import signal
from types import FrameType


class Interruption:
    """SIGINT and SIGTERM as a request, noted in `signal`; a second one ends the process at once."""

    def __init__(self) -> None:
        self.signal = 0

    def __enter__(self) -> "Interruption":
        self._before = {number: signal.signal(number, self._note) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, number: int, _: FrameType | None) -> None:
        self.signal = number
        self.__exit__()
        # What a command does on SIGTERM by itself would wait for the iteration's end.
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
