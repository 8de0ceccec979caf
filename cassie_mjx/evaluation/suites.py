"""The suites: what is asked of every agent, the same on MuJoCo C and on MJX.

Nothing is drawn at random, and every trial starts from steady walking on the flat, up to which MuJoCo C has walked the
agent: so the same trial begins in the same state on both engines.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeAlias

import jax
import numpy as np

from cassie_mjx.agents.make import make_agent
from cassie_mjx.agents.types import Agent, AgentState
from cassie_mjx.envs.scenario import PUSH_S
from cassie_mjx.evaluation.returns import agent_returns
from cassie_mjx.evaluation.scheduler import LimitSearch, Progress, run, run_trials
from cassie_mjx.evaluation.steady import steady
from cassie_mjx.evaluation.trial import AFTER_PUSH_S, EpisodeResult, Metric, NeverSteady, Trial
from cassie_mjx.physics.make import make_physics
from cassie_mjx.physics.types import Physics
from cassie_mjx.robot.model import MJX_TESTING, ModelConfig

WALK_S, LONG_WALK_S = 10.0, 60.0
PHASES = "(k + 1/2)/n"
"""Where trials begin, as results have it; those of before this was written begin at k/n."""
WALK_PHASES = (np.arange(10) + 0.5) / 10
"""Phases of the stride at which walks begin: others than training measures from (`returns.CHOOSING_PHASES`)."""
LIMIT_PHASES = (np.arange(8) + 0.5) / 8
"""Phases at which pushes, and walks over terrain, begin."""
PUSH_STEP_N, LARGEST_PUSH_N = 10, 400
DIRECTIONS = {"forward": (1, 0), "backward": (-1, 0), "left": (0, 1), "right": (0, -1)}
MAP_DIRECTIONS_DEG = np.arange(16) * 22.5
TERRAIN_STEP_M, HIGHEST_TERRAIN_M = 0.01, 0.4
LONGEST_DELAY_S = 0.02
RETURN_DELAYS_MS = (5, 10)


class SuiteResult(NamedTuple):
    """What a suite found out."""

    metrics: list[Metric]
    cells: Mapping[str, Any] | None = None
    """The single verdicts, for a suite whose cells are of interest."""


@dataclass(frozen=True)
class EvalSetup:
    """Where and for how long a suite is walked."""

    engine: str = "native"
    """"native": MuJoCo C; "mjx". Both at 2 kHz with full contacts."""
    long: bool = False
    """Whether what lasts 10 s is done for 60 s as well; those quantities end in _60s."""
    progress: Progress | None = None
    """Told how far it is."""

    def physics(self, scene: str = "flat", longest_delay_s: float = 0.0) -> Physics:
        """The engine, made for delays of up to `longest_delay_s`."""
        config = replace(MJX_TESTING if self.engine == "mjx" else ModelConfig(), scene=scene)
        make = _shared_engine if self.engine == "mjx" else make_physics
        return make(self.engine, config, round(longest_delay_s * config.physics_hz))

    def starts(self, agent: Agent, phases: np.ndarray, longest_delay_s: float = 0.0) -> AgentState:
        """The agent in steady walking at `phases` [B] of its stride, brought there by MuJoCo C."""
        return steady(agent, EvalSetup().physics(longest_delay_s=longest_delay_s), phases)

    @property
    def num_envs(self) -> int:
        """Robots side by side: on an accelerator as many as fit with ease, on a CPU what makes it fast."""
        if self.engine == "native":
            return 64
        return 256 if jax.default_backend() == "cpu" else 8192

    @property
    def durations(self) -> Sequence[tuple[float, str]]:
        """Durations of what lasts, s, and the suffix of their quantities."""
        return ((WALK_S, ""), (LONG_WALK_S, "_60s"))[: 1 + self.long]


@functools.cache
def _shared_engine(engine: str, config: ModelConfig, max_delay: int) -> Physics:
    """One engine for all suites that can share it, so that they share what is compiled for it."""
    return make_physics(engine, config, max_delay)


Suite: TypeAlias = Callable[[Agent, EvalSetup], SuiteResult]


def walk(agent: Agent, setup: EvalSetup) -> SuiteResult:
    """Undisturbed walking on the flat from ten phases of the stride.

    Of an agent that falls before it walks steadily, the returns and a survival of 0 s are all there is.
    """
    physics = setup.physics()
    metrics = agent_returns(agent, physics, WALK_PHASES)
    try:
        starts = setup.starts(agent, WALK_PHASES)
    except NeverSteady:
        metrics += [Metric("survived_s" + suffix, 0.0, "s", len(WALK_PHASES)) for _, suffix in setup.durations]
        return SuiteResult(metrics)
    for seconds, suffix in setup.durations:
        trials = [Trial(start, seconds) for start in range(len(WALK_PHASES))]
        metrics += walking_metrics(run_trials(agent, physics, starts, trials, setup.progress), suffix)
    return SuiteResult(metrics)


def walking_metrics(result: EpisodeResult, suffix: str = "") -> list[Metric]:
    """The shortest survival and the largest drift over the trials, and means of the rest."""
    return [
        Metric(quantity + suffix, float(value), unit, len(result.fell))
        for quantity, value, unit in (
            ("survived_s", result.survived_s.min(), "s"),
            ("speed_mps", result.speed_mps.mean(), "m/s"),
            ("distance_m", result.distance_m.mean(), "m"),
            ("pelvis_height_m", result.height_m.mean(), "m"),
            ("torque_nm", result.torque_nm.mean(), "N·m"),
            ("power_w", result.power_w.mean(), "W"),
            ("drift_m", np.abs(result.drift_m).max(), "m"),
        )
    ]


def push(agent: Agent, setup: EvalSetup) -> SuiteResult:
    """The largest push of 0.2 s in each direction, at the worst of eight phases and in the median; at most 400 N."""
    groups = [(direction, phase) for direction in DIRECTIONS.values() for phase in range(len(LIMIT_PHASES))]

    def trial(group: int, level: int) -> Trial:
        direction, phase = groups[group]
        return pushed(phase, direction, PUSH_STEP_N * (level + 1))

    search = LimitSearch(trial, len(groups), LARGEST_PUSH_N // PUSH_STEP_N)
    starts = setup.starts(agent, LIMIT_PHASES)
    run(agent, setup.physics(), starts, search, setup.num_envs, setup.progress)
    return SuiteResult(push_metrics(PUSH_STEP_N * search.limit.reshape(len(DIRECTIONS), -1), list(DIRECTIONS)))


def pushed(phase: int, direction: tuple[float, float], force: float) -> Trial:
    """The trial of a push along the unit vector `direction` (forward, left), N, at one of the starting phases."""
    forward, left = direction
    return Trial(phase, PUSH_S + AFTER_PUSH_S, push=(force * forward, force * left))


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
    forces = np.arange(PUSH_STEP_N, LARGEST_PUSH_N + 1, PUSH_STEP_N)
    trials = [
        pushed(phase, towards(degrees), force)
        for degrees in MAP_DIRECTIONS_DEG
        for phase in range(len(LIMIT_PHASES))
        for force in forces.tolist()
    ]
    starts = setup.starts(agent, LIMIT_PHASES)
    result = run_trials(agent, setup.physics(), starts, trials, setup.progress, setup.num_envs)
    return map_result(~result.fell.reshape(len(MAP_DIRECTIONS_DEG), len(LIMIT_PHASES), len(forces)), forces)


def map_result(survived: np.ndarray, forces: np.ndarray) -> SuiteResult:
    """The limits of each direction, the share of its pushes survived, and all verdicts [direction, phase, force]."""
    # The limit is the last force before the first fall.
    limits = np.append(0, forces)[survived.cumprod(axis=2).sum(axis=2)]
    names = [f"{angle:g}deg" for angle in MAP_DIRECTIONS_DEG]
    shares = [
        Metric(f"push_{name}_survived", float(cells.mean()), "1", cells.size)
        for name, cells in zip([*names, "map"], [*survived, survived], strict=True)
    ]
    cells = {
        "directions_deg": MAP_DIRECTIONS_DEG.tolist(),
        "phases": LIMIT_PHASES.tolist(),
        "forces_N": forces.tolist(),
        "survived": [["".join(str(int(cell)) for cell in row) for row in phases] for phases in survived],
    }
    return SuiteResult(push_metrics(limits, names) + shares, cells)


def terrain(agent: Agent, setup: EvalSetup) -> SuiteResult:
    """The largest h, at most 0.4 m, of the terrain z = h sin x that is survived from all of eight phases."""
    levels = round(HIGHEST_TERRAIN_M / TERRAIN_STEP_M)
    lasting = _Lasting("terrain_h_m", "m", TERRAIN_STEP_M, levels, lambda level: {"terrain": TERRAIN_STEP_M * level})
    starts = setup.starts(agent, LIMIT_PHASES)
    return SuiteResult(_limits(lasting, agent, setup.physics("terrain"), starts, setup))


def delay(agent: Agent, setup: EvalSetup) -> SuiteResult:
    """Walking with senses 5 and 10 ms late, and the longest delay, at most 20 ms, survived from all of ten phases."""
    physics = setup.physics(longest_delay_s=LONGEST_DELAY_S)
    starts = setup.starts(agent, WALK_PHASES, LONGEST_DELAY_S)
    step_ms = 1000 * physics.model.opt.timestep
    metrics = []
    for late_ms in RETURN_DELAYS_MS:
        steps = round(late_ms / step_ms)
        trials = [Trial(start, WALK_S, delay=steps) for start in range(len(WALK_PHASES))]
        survived_s = run_trials(agent, physics, starts, trials, setup.progress).survived_s
        late = agent_returns(agent, physics, WALK_PHASES, steps)
        late += [Metric("survived_s", float(survived_s.min()), "s", len(trials))]
        metrics += [metric._replace(quantity=f"delay_{late_ms}ms_{metric.quantity}") for metric in late]
    lasting = _Lasting("delay_max_ms", "ms", step_ms, physics.max_delay, lambda level: {"delay": level})
    return SuiteResult(metrics + _limits(lasting, agent, physics, starts, setup))


class _Lasting(NamedTuple):
    """A disturbance that lasts as long as the trial, at levels from 1 on."""

    quantity: str
    unit: str
    step: float
    """From level to level, in that unit."""
    levels: int
    disturb: Callable[[int], dict[str, Any]]
    """What a trial at a level has."""


def _limits(lasting: _Lasting, agent: Agent, physics: Physics, starts: AgentState, setup: EvalSetup) -> list[Metric]:
    """The largest level survived, with every smaller one, from all starts."""
    metrics, levels, groups = [], lasting.levels, len(starts.physics.step)
    for seconds, suffix in setup.durations:

        def trial(start: int, level: int, seconds: float = seconds) -> Trial:
            return Trial(start, seconds, **lasting.disturb(level + 1))

        search = LimitSearch(trial, groups, levels, together=True)
        run(agent, physics, starts, search, setup.num_envs, setup.progress)
        # Who falls within 10 s falls within 60 s: the longer search goes no further than the shorter one came.
        levels = int(search.limit.min())
        metrics.append(Metric(lasting.quantity + suffix, round(lasting.step * levels, 9), lasting.unit, groups))
    return metrics


SUITES: dict[str, Suite] = {"walk": walk, "delay": delay, "terrain": terrain, "push": push, "map": push_map}
ALL = ("walk", "delay", "terrain", "push")
"""What suite=all means: the map has every cell that `push` searches, and many more."""


def evaluate_agent(name: str, suite: str = "walk", setup: EvalSetup | None = None) -> list[Metric]:
    """The metrics of an agent in a suite.

    Args:
      name: of the agent, as every command takes it: "1x", a policy's file, a run's directory, "controller:stiff".
      suite: one of `SUITES`, or "all".
      setup: engine and duration; MuJoCo C at 2 kHz unless given.

    Raises:
      ValueError: there is no such agent or suite.
    """
    if suite not in (*SUITES, "all"):
        raise ValueError(f"suite={suite!r} is not known; choose one of {', '.join((*SUITES, 'all'))}.")
    agent = make_agent(name)
    chosen = ALL if suite == "all" else (suite,)
    return [metric for each in chosen for metric in SUITES[each](agent, setup or EvalSetup()).metrics]
