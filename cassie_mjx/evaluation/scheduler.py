"""Trials of an agent, many side by side, on either engine.

Every place of the batch is in a trial of its own. A place whose robot has fallen, or whose trial is over, takes the
next trial at once, so no time goes into robots on the ground.
"""

from collections.abc import Callable, Sequence
from functools import partial
from operator import itemgetter
from typing import Any, Protocol, TypeAlias

import jax
import numpy as np

from cassie_mjx.agents.types import Agent, AgentState
from cassie_mjx.evaluation import simulate
from cassie_mjx.evaluation.record import TrialRecord
from cassie_mjx.evaluation.simulate import Simulation
from cassie_mjx.evaluation.trial import EpisodeResult, Trial, placed, scenario_of, take
from cassie_mjx.physics.types import Physics, Scenario
from cassie_mjx.robot.arrays import Array

SMALLEST_BATCH = 8

Key: TypeAlias = tuple[int, ...]


class Trials(Protocol):
    """Where `run` takes its trials from."""

    def next(self) -> tuple[Key, Trial] | None:
        """The next trial to begin and the key that its result goes under; None once there will be no more."""
        ...

    def wanted(self, key: Key) -> bool:
        """Whether the outcome of a trial under way still matters."""
        ...

    def ended(self, key: Key, result: EpisodeResult) -> None:
        """Take the result, its fields scalars, of a trial."""
        ...


Progress: TypeAlias = Callable[[int, int], None]
"""Called every time that the robots have been advanced, with the number of trials over and of robots walking."""


def run(
    agent: Agent,
    physics: Physics,
    starts: AgentState,
    trials: Trials,
    num_envs: int = 64,
    progress: Progress | None = None,
    pushes: int = 1,
    varied: bool = False,
) -> None:
    """Run trials, `num_envs` at a time, until there are no more; results go to `trials.ended`.

    Args:
      agent: what walks.
      physics: the engine, at any rate that fits the agent's period.
      starts: robots that a trial can start as.
      trials: where trials come from and their results go.
      num_envs: robots side by side. On MuJoCo C the batch is halved when half of them have nothing to do.
      progress: called with how far it is.
      pushes: the most that a trial has.
      varied: whether a trial has a robot that differs from the model.

    Raises:
      ValueError: the agent's period does not divide the control step into whole physics steps, or a trial has a longer
        delay than the engine is made for.
    """
    batch, over = _Batch(agent, physics, starts, num_envs, partial(scenario_of, pushes=pushes, varied=varied)), 0
    while batch.fill(trials):
        batch.advance()
        over += batch.hand_in(trials)
        if progress is not None:
            progress(over, sum(job is not None for job in batch.jobs))


def run_trials(
    agent: Agent,
    physics: Physics,
    starts: AgentState,
    trials: Sequence[Trial],
    progress: Progress | None = None,
    num_envs: int | None = None,
) -> EpisodeResult:
    """Run these trials, all of them side by side or `num_envs` at a time; results [B] in their order.

    The other arguments are those of `run`.
    """
    listed = _Listed(trials)
    pushes = max((len(trial.pushes) for trial in trials), default=0)
    varied = any(trial.dynamics is not None for trial in trials)
    run(agent, physics, starts, listed, min(num_envs or len(trials), len(trials)), progress, max(pushes, 1), varied)
    return jax.tree.map(lambda *values: np.array(values), *(listed.results[i,] for i in range(len(trials))))


class LimitSearch:
    """Trials that find how many levels of a disturbance each group survives without a gap, from the smallest level up.

    The level begun next is the smallest that is open in any group. Once a level has failed, no larger one of its group
    is begun, run to its end or counted, even if its robot is still up.
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


class _Batch:
    """The places of `run`: their simulation, and the job (key, trial) of each; a free place has none."""

    def __init__(
        self, agent: Agent, physics: Physics, starts: AgentState, num_envs: int, scenario: Callable[..., Scenario]
    ) -> None:
        self.agent, self.physics, self.starts, self.scenario_of = agent, physics, starts, scenario
        self.jobs: list[tuple[Key, Trial] | None] = [None] * num_envs
        self.simulation = self._begin([_IDLE] * num_envs)

    def _begin(self, trials: list[Trial]) -> Simulation:
        robots = placed(self.agent, self.starts, trials)
        hertz = 1 / self.physics.model.opt.timestep
        scenario = self.scenario_of(self.agent, trials, robots.physics, hertz)
        simulate.check_agent(self.agent, self.physics, scenario)
        return Simulation(robots, scenario, TrialRecord.begin(robots.physics.qpos, trials))

    def fill(self, trials: Trials) -> bool:
        """Give every free place a job; False when no job is left. Places still free start over, to do nothing."""
        free = [place for place, job in enumerate(self.jobs) if job is None]
        if free:
            for place in free:
                self.jobs[place] = trials.next()
            begun = self._begin([_IDLE if (job := self.jobs[place]) is None else job[1] for place in free])
            self.simulation = _put(self.simulation, np.array(free), begun)
        # A batch of another size would have to be compiled anew.
        if not self.physics.traceable:
            self._halve()
        return any(self.jobs)

    def _halve(self) -> None:
        """Halve the batch while half of its places have nothing to do."""
        busy, size = sum(job is not None for job in self.jobs), len(self.jobs)
        while size > SMALLEST_BATCH and 2 * busy <= size:
            size //= 2
        if size < len(self.jobs):
            keep = sorted(range(len(self.jobs)), key=lambda place: self.jobs[place] is None)[:size]
            self.jobs = [self.jobs[place] for place in keep]
            self.simulation = take(self.simulation, np.array(keep))

    def advance(self) -> None:
        """Let time pass for all places."""
        self.simulation = simulate.advance(self.agent, self.physics, self.simulation)

    def hand_in(self, trials: Trials) -> int:
        """Hand in the results of what is over now; returns how many. Places with unwanted trials become free, too."""
        record: TrialRecord = jax.tree.map(np.asarray, self.simulation.record)
        over = [(place, job) for place, job in enumerate(self.jobs) if job is not None and record.finished[place]]
        if over:
            results = record.result()
            for place, (key, _) in over:
                trials.ended(key, jax.tree.map(itemgetter(place), results))
                self.jobs[place] = None
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
