"""A signal that asks a run to stop: it is noted, and the run ends after its present iteration."""

import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)

ONE_S = 0.5
"""Time in which signals count as one, s: `timeout` sends its own twice, to its child and to the group of both."""


class Interruption:
    """SIGINT and SIGTERM as a request, noted in `signal`; a second one ends the process at once, with a sentence.

    Python runs a signal's handler between two of its own instructions, and a compiled program takes seconds, its
    compilation minutes. The number of a signal goes into a pipe at once; a thread waits there for the second.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        """Take what is to be said at the first signal."""
        self.signal, self._say = 0, say

    def __enter__(self) -> "Interruption":
        # Python handles signals in its main thread alone; elsewhere a training runs to its end.
        if threading.current_thread() is not threading.main_thread():
            self._before = {}
            return self
        self._reader, self._writer = os.pipe()
        os.set_blocking(self._writer, False)
        self._pipe_before = signal.set_wakeup_fd(self._writer, warn_on_full_buffer=False)
        self._before = {number: signal.signal(number, self._note) for number in SIGNALS}
        self._thread = threading.Thread(target=self._wait_for_second, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        if not self._before:
            return
        for number, handler in self._before.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(self._pipe_before)
        os.close(self._writer)
        self._thread.join()
        os.close(self._reader)

    def _note(self, number: int, _: FrameType | None) -> None:
        self.signal = number

    def _wait_for_second(self) -> None:
        first = None
        while number := os.read(self._reader, 1):
            if number[0] not in SIGNALS:
                continue
            if first is None:
                # A terminal that is gone must not keep the second signal from being seen.
                with suppress(Exception):
                    self._say(
                        "Stopping after this iteration, with a checkpoint; a second signal stops at once, without."
                    )
                first = time.monotonic()
                continue
            if time.monotonic() - first < ONE_S:
                continue
            cursor = "\x1b[?25h" if sys.stderr.isatty() else ""
            os.write(2, f"{cursor}Stopped at once; resume=true goes on from the last checkpoint.\n".encode())
            os._exit(128 + number[0])
