"""Trials of a walker, many side by side, on either engine.

Every lane of the batch is in a trial of its own. A lane whose robot has fallen, or whose trial is over, takes the next
trial at once, so no time goes into robots on the ground.
"""

from collections.abc import Callable, Sequence
from operator import itemgetter
from typing import Any, Protocol, TypeAlias

import jax
import numpy as np

from cassie_mjx.evaluation import simulate
from cassie_mjx.evaluation.record import Record
from cassie_mjx.evaluation.simulate import Flight
from cassie_mjx.evaluation.trial import EpisodeResult, Subject, Trial, Walker, take
from cassie_mjx.physics.mjx import MjxPhysics
from cassie_mjx.physics.types import Array, Physics

SMALLEST_BATCH = 8

Key: TypeAlias = tuple[int, ...]


class Trials(Protocol):
    """Where `conduct` takes its trials from."""

    def next(self) -> tuple[Key, Trial] | None:
        """The next trial to begin and the key that its result goes under; None once there will be no more."""
        ...

    def wanted(self, key: Key) -> bool:
        """Whether the outcome of a trial under way still matters."""
        ...

    def ended(self, key: Key, result: EpisodeResult) -> None:
        """Take the result, its fields scalars, of a trial."""
        ...


Watch: TypeAlias = Callable[[int, int], None]
"""Called after every advance of the lanes with the number of trials over and of robots walking."""


def conduct(
    subject: Subject, physics: Physics, starts: Walker, trials: Trials, lanes: int = 64, watch: Watch | None = None
) -> None:
    """Conduct trials, `lanes` at a time, until there are no more; results go to `trials.ended`.

    Args:
      subject: what walks.
      physics: the engine, at any rate that fits the subject's period.
      starts: walkers that a trial can start as.
      trials: where trials come from and their results go.
      lanes: robots side by side. On MuJoCo C the batch is halved when half of them have nothing to do.
      watch: told of progress.

    Raises:
      ValueError: the subject's period does not divide the control step into whole physics steps.
    """
    batch, over = _Lanes(subject, physics, starts, lanes), 0
    while batch.fill(trials):
        batch.advance()
        over += batch.land(trials)
        if watch is not None:
            watch(over, sum(job is not None for job in batch.jobs))


def fly(
    subject: Subject,
    physics: Physics,
    starts: Walker,
    trials: Sequence[Trial],
    watch: Watch | None = None,
    lanes: int | None = None,
) -> EpisodeResult:
    """Conduct these trials, all of them side by side or `lanes` at a time; results [B] in their order.

    The other arguments are those of `conduct`.
    """
    listed = _Listed(trials)
    conduct(subject, physics, starts, listed, min(lanes or len(trials), len(trials)), watch)
    return jax.tree.map(lambda *values: np.array(values), *(listed.results[i,] for i in range(len(trials))))


class LimitSearch:
    """Trials that find how many levels of a disturbance each group survives without a gap, from the smallest level up.

    The level begun next is the smallest that is open in any group. Once a level has failed, no larger one of its group
    is begun, flown to its end or counted, even if its robot is still up.
    """

    def __init__(self, trial: Callable[[int, int], Trial], groups: int, levels: int, together: bool = False) -> None:
        """Make a search.

        Args:
          trial: the trial of (group, level), both counted from 0.
          groups: number of groups, such as directions x phases.
          levels: number of levels.
          together: whether a failure in one group is a failure of all.
        """
        self.trial, self.together = trial, together
        self.begun = np.zeros(groups, int)
        self.limit = np.full(groups, levels)
        """For each group the smallest level failed, which is the number of levels survived once the search is over."""

    def next(self) -> tuple[Key, Trial] | None:
        """See `Trials.next`."""
        open_groups = np.flatnonzero(self.begun < self.limit)
        if not len(open_groups):
            return None
        group = int(open_groups[np.argmin(self.begun[open_groups])])
        level = int(self.begun[group])
        self.begun[group] += 1
        return (group, level), self.trial(group, level)

    def wanted(self, key: Key) -> bool:
        """See `Trials.wanted`."""
        group, level = key
        return level < self.limit[group]

    def ended(self, key: Key, result: EpisodeResult) -> None:
        """See `Trials.ended`."""
        group, level = key
        if result.fell:
            failed = slice(None) if self.together else group
            self.limit[failed] = np.minimum(self.limit[failed], level)


class _Listed:
    """Trials that are all known beforehand."""

    def __init__(self, trials: Sequence[Trial]) -> None:
        self.waiting = iter([((index,), trial) for index, trial in enumerate(trials)])
        self.results: dict[Key, EpisodeResult] = {}

    def next(self) -> tuple[Key, Trial] | None:
        return next(self.waiting, None)

    def wanted(self, key: Key) -> bool:
        return True

    def ended(self, key: Key, result: EpisodeResult) -> None:
        self.results[key] = result


class _Lanes:
    """The lanes of `conduct`: robots in flight, and the job (key, trial) of each; a free lane has none."""

    def __init__(self, subject: Subject, physics: Physics, starts: Walker, lanes: int) -> None:
        self.subject, self.physics, self.starts = subject, physics, starts
        self.jobs: list[tuple[Key, Trial] | None] = [None] * lanes
        self.flight = self._begin([_IDLE] * lanes)

    def _begin(self, trials: list[Trial]) -> Flight:
        return simulate.begin(self.subject, self.physics, self.starts, trials)

    def fill(self, trials: Trials) -> bool:
        """Give every free lane a job; False when no job is left. Lanes still free start over, to do nothing."""
        free = [lane for lane, job in enumerate(self.jobs) if job is None]
        if free:
            for lane in free:
                self.jobs[lane] = trials.next()
            begun = self._begin([_IDLE if (job := self.jobs[lane]) is None else job[1] for lane in free])
            self.flight = _put(self.flight, np.array(free), begun)
        # A batch of another size would have to be compiled anew.
        if not isinstance(self.physics, MjxPhysics):
            self._halve()
        return any(self.jobs)

    def _halve(self) -> None:
        """Halve the batch while half of its lanes have nothing to do."""
        busy, size = sum(job is not None for job in self.jobs), len(self.jobs)
        while size > SMALLEST_BATCH and 2 * busy <= size:
            size //= 2
        if size < len(self.jobs):
            keep = sorted(range(len(self.jobs)), key=lambda lane: self.jobs[lane] is None)[:size]
            self.jobs = [self.jobs[lane] for lane in keep]
            self.flight = take(self.flight, np.array(keep))

    def advance(self) -> None:
        """Let time pass for all lanes."""
        self.flight = simulate.advance(self.subject, self.physics, self.flight)

    def land(self, trials: Trials) -> int:
        """Hand in the results of what is over now; returns how many. Lanes with unwanted trials become free, too."""
        record: Record = jax.tree.map(np.asarray, self.flight.record)
        over = [(lane, job) for lane, job in enumerate(self.jobs) if job is not None and record.over[lane]]
        if over:
            results = record.result()
            for lane, (key, _) in over:
                trials.ended(key, jax.tree.map(itemgetter(lane), results))
                self.jobs[lane] = None
        self.jobs = [job if job is not None and trials.wanted(job[0]) else None for job in self.jobs]
        return len(over)


_IDLE = Trial(start=0, seconds=0.0)


def _put(tree: Any, index: np.ndarray, robots: Any) -> Any:
    """A pytree with robots `index` replaced, as NumPy arrays."""

    def put(leaf: Array, new: Array) -> np.ndarray:
        leaf = np.array(leaf)
        leaf[index] = new
        return leaf

    return jax.tree.map(put, tree, robots)
