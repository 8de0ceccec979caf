"""The suites: what is asked of every agent, the same on MuJoCo C and on MJX; `command` of single policies alone.

Random pushes and robots are drawn with seed 0, and every trial starts from steady walking on the flat, up to which
MuJoCo C has walked the agent: so the same trial begins in the same state on both engines.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from cassie_mjx.agents.make import make_agent
from cassie_mjx.agents.types import Agent, AgentState
from cassie_mjx.evaluation.driving import command
from cassie_mjx.evaluation.dynamics import dynamics
from cassie_mjx.evaluation.pushes import forces, push, push_map
from cassie_mjx.evaluation.returns import agent_returns
from cassie_mjx.evaluation.scheduler import LimitSearch, run, run_trials
from cassie_mjx.evaluation.sensors import sensors
from cassie_mjx.evaluation.setup import LIMIT_PHASES, LONG_WALK_S, WALK_PHASES, WALK_S, EvalSetup, SuiteResult
from cassie_mjx.evaluation.trial import EpisodeResult, Metric, NeverSteady, Trial
from cassie_mjx.physics.types import Physics
from cassie_mjx.robot.ground import HIGHEST, Terrain

TERRAIN_STEP_M, HIGHEST_TERRAIN_M = 0.01, 0.8
LONGEST_DELAY_S = 0.04
RETURN_DELAYS_MS = (5, 10)
HIGHEST_TRIED = {
    "terrain_h_m": HIGHEST_TERRAIN_M,
    "terrain_h_m_60s": HIGHEST_TERRAIN_M,
    "delay_max_ms": 1000 * LONGEST_DELAY_S,
}
"""The highest level tried of limits of `ALL`, as results have it: one that reaches it may be larger."""

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


def terrain(agent: Agent, setup: EvalSetup) -> SuiteResult:
    """The largest h, at most 0.8 m, of the terrain z = h sin x that is survived from all of eight phases."""
    limit = _terrain_limit("terrain_h_m", "sine", TERRAIN_STEP_M, HIGHEST_TERRAIN_M)
    starts = setup.starts(agent, LIMIT_PHASES)
    return SuiteResult(_limits(limit, agent, setup.physics("terrain"), starts, setup))


def ground(agent: Agent, setup: EvalSetup) -> SuiteResult:
    """Slopes up, down and across, steps and rough ground, each to the largest level survived from all eight phases.

    Slopes and steps are walked for 10 s, rough ground for 60 s.
    """
    starts, metrics = setup.starts(agent, LIMIT_PHASES), []
    for scene, limits in GROUNDS.items():
        physics = setup.physics(scene)
        metrics += [metric for limit in limits for metric in _limits(limit, agent, physics, starts, setup)]
    return SuiteResult(metrics)


def delay(agent: Agent, setup: EvalSetup) -> SuiteResult:
    """Walking with senses 5 and 10 ms late, and the longest delay, at most 40 ms, survived from all of ten phases."""
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
    seconds: float | None = None
    """Duration, s; those of the setup unless given."""


def _terrain_limit(quantity: str, kind: str, step: float, highest: float, seconds: float | None = None) -> _Lasting:
    """Of a kind of terrain; with a step below 0, slopes go downhill or to the right."""
    unit = "rad" if kind in ("slope", "across") else "m"

    def disturb(level: int) -> dict[str, Any]:
        return {"terrain": Terrain(kind, step * level)}

    return _Lasting(quantity, unit, abs(step), round(highest / abs(step)), disturb, seconds)


GROUNDS = {
    "terrain": (
        _terrain_limit("slope_up_max_rad", "slope", 0.05, HIGHEST["slope"], WALK_S),
        _terrain_limit("slope_down_max_rad", "slope", -0.05, HIGHEST["slope"], WALK_S),
        _terrain_limit("slope_across_max_rad", "across", 0.05, HIGHEST["across"], WALK_S),
        _terrain_limit("steps_max_m", "steps", 0.01, HIGHEST["steps"], WALK_S),
    ),
    "rough": (_terrain_limit("rough_max_m", "rough", 0.01, HIGHEST["rough"], LONG_WALK_S),),
}
"""The limits of the suite `ground` by scene."""


def _limits(lasting: _Lasting, agent: Agent, physics: Physics, starts: AgentState, setup: EvalSetup) -> list[Metric]:
    """The largest level survived, with every smaller one, from all starts."""
    metrics, levels, groups = [], lasting.levels, len(starts.physics.step)
    for seconds, suffix in setup.durations if lasting.seconds is None else ((lasting.seconds, ""),):

        def trial(start: int, level: int, seconds: float = seconds) -> Trial:
            return Trial(start, seconds, **lasting.disturb(level + 1))

        search = LimitSearch(trial, groups, levels, together=True)
        run(agent, physics, starts, search, setup.num_envs, setup.progress)
        # Who falls within 10 s falls within 60 s: the longer search goes no further than the shorter one came.
        levels = int(search.limit.min())
        metrics.append(Metric(lasting.quantity + suffix, round(lasting.step * levels, 9), lasting.unit, groups))
    return metrics


SUITES: dict[str, Suite] = {
    "walk": walk,
    "delay": delay,
    "terrain": terrain,
    "ground": ground,
    "push": push,
    "map": push_map,
    "forces": forces,
    "command": command,
    "dynamics": dynamics,
    "sensors": sensors,
}
ALL = ("walk", "delay", "terrain", "push")
"""What suite=all means: the paper's experiments. The others take several minutes each."""


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
