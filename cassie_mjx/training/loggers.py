"""Where numbers go: JSON lines, TensorBoard, the terminal; and where the time went."""

import json
import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, Protocol, TypeVar

import jax
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event, SessionLog
from tensorboardX.proto.summary_pb2 import Summary
from tensorboardX.summary import scalar

from cassie_mjx.files.atomic import write_text
from cassie_mjx.training.config import TrainConfig, flat
from cassie_mjx.training.trackers import TRACKERS

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


class Sink(Protocol):
    """Where the lines of metrics go, and films."""

    def write(self, values: Mapping[str, float]) -> None:
        """Take a line of metrics, among them train/samples."""
        ...

    def film(self, path: Path, samples: int) -> None:
        """Take a film, .gif, of the policy after `samples` samples."""
        ...

    def close(self, finished: bool) -> None:
        """Take note that nothing follows, and whether the run is at its end."""
        ...


class Sinks:
    """All sinks of a run as one; a tracker that fails gets nothing more, and the run goes on."""

    def __init__(self, folder: Path, config: TrainConfig, samples: int, say: Callable[[str], None]) -> None:
        """Begin what `config.log` names, for a run in `folder` that goes on after `samples` samples.

        Raises:
          ValueError: a tracker does not start.
        """
        ours = {
            "jsonl": lambda: JsonLines(folder / "metrics.jsonl", samples),
            "tensorboard": lambda: TensorBoard(folder / "tensorboard", samples),
        }
        self._say = say
        self._sinks = [ours[name]() if name in ours else _tracker(name, folder, config) for name in config.log]

    def write(self, values: Mapping[str, float]) -> None:
        """See `Sink.write`."""
        self._each(lambda sink: sink.write(values))

    def film(self, path: Path, samples: int) -> None:
        """See `Sink.film`."""
        self._each(lambda sink: sink.film(path, samples))

    def close(self, finished: bool) -> None:
        """See `Sink.close`."""
        self._each(lambda sink: sink.close(finished))

    def _each(self, hand_on: Callable[[Sink], None]) -> None:
        for sink in tuple(self._sinks):
            try:
                hand_on(sink)
            except OSError:
                raise
            except Exception as error:
                self._sinks.remove(sink)
                self._say(f"{type(sink).__name__} failed and gets nothing more of this run: {_first_line(error)}")


def _tracker(name: str, folder: Path, config: TrainConfig) -> Sink:
    try:
        return TRACKERS[name](folder, flat(asdict(config)))
    except Exception as error:
        raise ValueError(f"log={name} does not start: {_first_line(error)}") from error


def _first_line(error: Exception) -> str:
    """What an error of another library says, in short."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]


class JsonLines:
    """One JSON object a line."""

    def __init__(self, path: Path, samples: int) -> None:
        """Open `path` to append; lines of more than `samples` train/samples, or broken ones, are of a lost future."""
        self._path = path
        lines = path.read_text(errors="replace").splitlines() if path.exists() else []
        kept = [line for line in lines if _samples_of(line) <= samples]
        write_text(path, "".join(line + "\n" for line in kept))

    def write(self, values: Mapping[str, float]) -> None:
        """Append one line; a value that is not finite, which JSON has no number for, is null.

        Raises:
          OSError: it cannot be written, for instance on a full disk.
        """
        with _writing(self._path), self._path.open("a") as file:
            finite = {name: value if math.isfinite(value) else None for name, value in values.items()}
            file.write(json.dumps(finite) + "\n")

    def film(self, path: Path, samples: int) -> None:
        """Leave the film where it is."""

    def close(self, finished: bool) -> None:
        """Nothing is open."""


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

    def film(self, path: Path, samples: int) -> None:
        """Add the film to the images."""
        image = Summary.Image(encoded_image_string=path.read_bytes())
        with _writing(self._folder):
            summary = Summary(value=[Summary.Value(tag="film", image=image)])
            self._writer.write_event(Event(wall_time=time.time(), step=samples, summary=summary))
            self._writer.flush()

    def close(self, finished: bool) -> None:
        """Write what is left."""
        with _writing(self._folder):
            self._writer.close()


class Terminal:
    """Progress that a person can follow: a bar on a terminal, and a line a checkpoint everywhere."""

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
        """Print a sentence as it is: what is in brackets, such as a unit, is no markup."""
        self._console.print(sentence, soft_wrap=True, highlight=False, markup=False, emoji=False)

    def advance(self, reward: float, episode_steps: float, samples_per_s: float) -> None:
        """Move the bar on by an iteration."""
        description = f"reward {reward:.3f} a step, episodes {episode_steps:.0f} steps, {samples_per_s:,.0f} samples/s"
        self._bar.update(self._task, advance=1, description=description)

    def write(self, values: Mapping[str, float]) -> None:
        """Print a line of metrics."""
        iteration = int(values["train/iteration"])
        spent = time.perf_counter() - self._start
        left = spent / max(iteration - self._first, 1) * (self._total - iteration)
        measured = ""
        if "eval/steps" in values:
            measured = (
                f"  return {values['eval/return_weighted']:.1f} weighted {values['eval/return_plain']:.1f} plain of 300"
                f"  walked {values['eval/steps']:.0f}/300 steps"
            )
        self.say(
            f"iteration {iteration}/{self._total}  samples {int(values['train/samples']):,}{measured}"
            f"  reward {values['learner/reward']:.3f} a step"
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
        return float(json.loads(line)["train/samples"])
    except (ValueError, KeyError, TypeError, RecursionError):
        return float("inf")
