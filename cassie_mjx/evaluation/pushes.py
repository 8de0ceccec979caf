"""The suites of pushes: forces at the pelvis, from every side and for a tenth of a second to ten seconds."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from cassie_mjx.agents.types import Agent, AgentState
from cassie_mjx.evaluation.scheduler import LimitSearch, run, run_trials
from cassie_mjx.evaluation.setup import LIMIT_PHASES, LONG_WALK_S, EvalSetup, SuiteResult
from cassie_mjx.evaluation.trial import AFTER_PUSH_S, Metric, Push, Trial
from cassie_mjx.physics.types import Physics

PUSH_STEP_N, LARGEST_PUSH_N = 10, 400
DIRECTIONS = {"forward": (1, 0), "backward": (-1, 0), "left": (0, 1), "right": (0, -1)}
MAP_DIRECTIONS_DEG = np.arange(16) * 22.5
RANDOM_ROBOTS, RANDOM_PUSH_N, RANDOM_EVERY_S = 100, 300.0, 2.0


class _Kind(NamedTuple):
    """A way to be pushed along one direction, at levels from 1 on."""

    largest_n: int
    step_n: int
    pushes: Callable[[float, float], tuple[Push, ...]]
    """Of a force forward and to the left, N."""


FORCES: Mapping[str, _Kind] = {
    "push_0.1s": _Kind(800, 20, lambda x, y: (Push(x, y, seconds=0.1),)),
    "push_0.5s": _Kind(400, 10, lambda x, y: (Push(x, y, seconds=0.5),)),
    "push_1s": _Kind(400, 10, lambda x, y: (Push(x, y, seconds=1.0),)),
    "push_twice": _Kind(400, 10, lambda x, y: (Push(x, y), Push(x, y, start_s=0.5))),
    "steady": _Kind(200, 5, lambda x, y: (Push(x, y, seconds=10.0),)),
}
"""The forces of `forces`: `push_twice` has two pushes of 0.2 s, the second half a second after the first began."""


def push(agent: Agent, setup: EvalSetup) -> SuiteResult:
    """The largest push of 0.2 s in each direction, at the worst of eight phases and in the median; at most 400 N."""
    kind = _Kind(LARGEST_PUSH_N, PUSH_STEP_N, lambda x, y: (Push(x, y),))
    limits = _limits(kind, agent, setup.physics(), setup.starts(agent, LIMIT_PHASES), setup)
    return SuiteResult(push_metrics(limits, list(DIRECTIONS)))


def forces(agent: Agent, setup: EvalSetup) -> SuiteResult:
    """Largest pushes of other durations, two pushes, steady forces of 10 s; and who bears random pushes for 60 s."""
    metrics, physics, starts = [], setup.physics(), setup.starts(agent, LIMIT_PHASES)
    for name, kind in FORCES.items():
        found = push_metrics(_limits(kind, agent, physics, starts, setup), list(DIRECTIONS))
        metrics += [metric._replace(quantity=metric.quantity.replace("push", name, 1)) for metric in found]
    result = run_trials(agent, physics, starts, random_pushes(), setup.progress)
    survived = Metric("push_random_survived_60s", float((~result.fell).mean()), "1", RANDOM_ROBOTS)
    return SuiteResult([*metrics, survived])


def random_pushes() -> list[Trial]:
    """Of 100 robots, 60 s each: every 2 s a push of 0.2 s, of 0 to 300 N in any direction; drawn with seed 0."""
    draw, trials = np.random.default_rng(0), []
    times = np.arange(0, LONG_WALK_S, RANDOM_EVERY_S).tolist()
    for robot in range(RANDOM_ROBOTS):
        force = draw.uniform(0, RANDOM_PUSH_N, len(times))
        angle = draw.uniform(0, 2 * np.pi, len(times))
        along = np.stack([force * np.cos(angle), force * np.sin(angle), times], axis=1)
        trials.append(Trial(robot % len(LIMIT_PHASES), LONG_WALK_S, tuple(Push(*each) for each in along.tolist())))
    return trials


def _limits(kind: _Kind, agent: Agent, physics: Physics, starts: AgentState, setup: EvalSetup) -> np.ndarray:
    """The largest force survived with every smaller one, [direction, phase], N."""
    groups = [(direction, phase) for direction in DIRECTIONS.values() for phase in range(len(LIMIT_PHASES))]

    def trial(group: int, level: int) -> Trial:
        direction, phase = groups[group]
        return pushed(phase, direction, kind.step_n * (level + 1), kind.pushes)

    search = LimitSearch(trial, len(groups), kind.largest_n // kind.step_n)
    run(agent, physics, starts, search, setup.num_envs, setup.progress, len(kind.pushes(0.0, 0.0)))
    return kind.step_n * search.limit.reshape(len(DIRECTIONS), -1)


def pushed(
    phase: int,
    direction: tuple[float, float],
    force: float,
    pushes: Callable[[float, float], tuple[Push, ...]] = lambda x, y: (Push(x, y),),
) -> Trial:
    """The trial of a push along the unit vector `direction` (forward, left), N, at one of the starting phases.

    It goes on for 4 s after the last of `pushes`, which is one of 0.2 s unless given.
    """
    forward, left = direction
    acting = pushes(force * forward, force * left)
    last = max(each.start_s + each.seconds for each in acting)
    return Trial(phase, last + AFTER_PUSH_S, acting)


def towards(degrees: float) -> tuple[float, float]:
    """Unit vector (forward, left) at an angle from forward to the left; exact along the axes."""
    angle = np.deg2rad(degrees)
    return round(float(np.cos(angle)), 15), round(float(np.sin(angle)), 15)


def push_metrics(limits: np.ndarray, names: Sequence[str]) -> list[Metric]:
    """Worst and median phase of the limits [direction, phase], N, of directions with these names."""
    worst = [(f"push_{name}_N", row.min(), len(row)) for name, row in zip(names, limits, strict=True)]
    median = [(f"push_{name}_median_N", np.median(row), len(row)) for name, row in zip(names, limits, strict=True)]
    return [Metric(name, float(value), "N", n) for name, value, n in worst + median]


def push_map(agent: Agent, setup: EvalSetup) -> SuiteResult:
    """Every push of 10 to 400 N in 16 directions at eight phases, none left out."""
    forces_n = np.arange(PUSH_STEP_N, LARGEST_PUSH_N + 1, PUSH_STEP_N)
    trials = [
        pushed(phase, towards(degrees), force)
        for degrees in MAP_DIRECTIONS_DEG
        for phase in range(len(LIMIT_PHASES))
        for force in forces_n.tolist()
    ]
    starts = setup.starts(agent, LIMIT_PHASES)
    result = run_trials(agent, setup.physics(), starts, trials, setup.progress, setup.num_envs)
    return map_result(~result.fell.reshape(len(MAP_DIRECTIONS_DEG), len(LIMIT_PHASES), len(forces_n)), forces_n)


def map_result(survived: np.ndarray, forces_n: np.ndarray) -> SuiteResult:
    """The limits of each direction, the weakest of all, the share of pushes survived, and all verdicts.

    Args:
      survived: [direction, phase, force], bool.
      forces_n: the forces, N.
    """
    # The limit is the last force before the first fall.
    limits = np.append(0, forces_n)[survived.cumprod(axis=2).sum(axis=2)]
    names = [f"{angle:g}deg" for angle in MAP_DIRECTIONS_DEG]
    worst = Metric("push_worst_N", float(limits.min()), "N", limits.size)
    shares = [
        Metric(f"push_{name}_survived", float(cells.mean()), "1", cells.size)
        for name, cells in zip([*names, "map"], [*survived, survived], strict=True)
    ]
    cells = {
        "directions_deg": MAP_DIRECTIONS_DEG.tolist(),
        "phases": LIMIT_PHASES.tolist(),
        "forces_N": forces_n.tolist(),
        "survived": [["".join(str(int(cell)) for cell in row) for row in phases] for phases in survived],
    }
    return SuiteResult([*push_metrics(limits, names), worst, *shares], cells)
