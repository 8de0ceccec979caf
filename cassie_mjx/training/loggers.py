"""Where numbers go: JSON lines, TensorBoard, the terminal; and where the time went."""

import json
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import jax
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event, SessionLog
from tensorboardX.summary import scalar

R = TypeVar("R")


class Stopwatch:
    """Seconds spent in each of several named functions."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    def timed(self, name: str, function: Callable[..., R]) -> Callable[..., R]:
        """`function`, with the time until its results are there counted under `name`."""

        def wrapped(*args: Any) -> R:
            start = time.perf_counter()
            result = jax.block_until_ready(function(*args))
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
            return result

        return wrapped

    def since_last(self) -> dict[str, float]:
        """The seconds since the last call, by name."""
        seconds, self.seconds = self.seconds, {}
        return seconds


class JsonLines:
    """One JSON object a line."""

    def __init__(self, path: Path, samples: int) -> None:
        """Open `path` to append; lines of more than `samples` train/samples, or broken ones, are of a lost future."""
        self._path = path
        lines = path.read_text().splitlines() if path.exists() else []
        kept = [line for line in lines if _samples_of(line) <= samples]
        partial = path.with_name(path.name + ".partial")
        partial.write_text("".join(line + "\n" for line in kept))
        partial.replace(path)

    def write(self, values: Mapping[str, float]) -> None:
        """Append one line.

        Raises:
          OSError: it cannot be written, for instance on a full disk.
        """
        with _writing(self._path), self._path.open("a") as file:
            file.write(json.dumps(values) + "\n")


class TensorBoard:
    """Scalars over samples, for `tensorboard --logdir runs`."""

    def __init__(self, folder: Path, samples: int) -> None:
        """Add to the curves in `folder` after `samples` samples; what is there beyond is of a lost future."""
        self._folder = folder
        folder.mkdir(exist_ok=True)
        # tensorboardX's SummaryWriter would write from a thread, whose errors nobody catches.
        self._writer = EventsWriter(str(folder / "events"))
        self._writer.write_event(Event(step=samples + 1, session_log=SessionLog(status=SessionLog.START)))

    def write(self, values: Mapping[str, float]) -> None:
        """Add a point to each curve.

        Raises:
          OSError: it cannot be written, for instance on a full disk.
        """
        now, step = time.time(), int(values["train/samples"])
        with _writing(self._folder):
            for name, value in values.items():
                self._writer.write_event(Event(wall_time=now, step=step, summary=scalar(name, value)))
            self._writer.flush()


class Terminal:
    """Progress that a person can follow: a bar on a terminal, and a line an evaluation everywhere."""

    def __init__(self, console: Console, iterations: int, done: int) -> None:
        """Start at `done` of `iterations`."""
        self._console = console
        self._bar = Progress(
            TextColumn("iteration {task.completed:.0f}/{task.total:.0f}"),
            BarColumn(),
            TextColumn("{task.description}"),
            TimeRemainingColumn(),
            TextColumn("left"),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task("", total=iterations, completed=done)
        self._start, self._first, self._total = time.perf_counter(), done, iterations

    def __enter__(self) -> "Terminal":
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def say(self, sentence: str) -> None:
        """Print a sentence."""
        self._console.print(sentence, soft_wrap=True, highlight=False, markup=False)

    def advance(self, reward: float, episode_steps: float, samples_per_s: float) -> None:
        """Move the bar on by an iteration."""
        description = f"reward {reward:.3f} a step, episodes {episode_steps:.0f} steps, {samples_per_s:,.0f} samples/s"
        self._bar.update(self._task, advance=1, description=description)

    def write(self, values: Mapping[str, float]) -> None:
        """Print a line about an evaluation."""
        iteration = int(values["train/iteration"])
        spent = time.perf_counter() - self._start
        left = spent / max(iteration - self._first, 1) * (self._total - iteration)
        self.say(
            f"iteration {iteration}/{self._total}  samples {int(values['train/samples']):,}"
            f"  return {values['eval/return_weighted']:.1f} weighted {values['eval/return_plain']:.1f} plain of 300"
            f"  walked {values['eval/steps']:.0f}/300 steps"
            f"  training episodes {values['train/episode_steps']:.0f} steps"
            f"  {values['time/samples_per_s']:,.0f} samples/s  {left:.0f} s left"
        )


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OSError(f"{path} could not be written ({error.strerror or error}).") from error


def _samples_of(line: str) -> float:
    try:
        return json.loads(line)["train/samples"]
    except (ValueError, KeyError, TypeError):
        return float("inf")
