"""The suite of dynamics: how many of the robots that are drawn from a range stay up."""

from operator import itemgetter

import jax
import numpy as np

from cassie_mjx.agents.types import Agent
from cassie_mjx.envs.dynamics import RANGES, DynamicsRange, draw_dynamics
from cassie_mjx.evaluation.scheduler import run_trials
from cassie_mjx.evaluation.setup import LIMIT_PHASES, WALK_S, EvalSetup, SuiteResult
from cassie_mjx.evaluation.trial import Metric, Trial

ROBOTS = 200
SCALES = {"": 1.0, "_x0.5": 0.5, "_x1.5": 1.5, "_x2": 2.0}
"""How far the ranges are scaled, by the suffix of the quantity."""


def dynamics(agent: Agent, setup: EvalSetup) -> SuiteResult:
    """The share of 200 robots up for 10 s, drawn from each range and from each range scaled.

    The same random numbers make the robots of all scales.
    """
    spans = {
        f"dynamics_{name}_survived{suffix}": span.scaled(scale)
        for name, span in RANGES.items()
        for suffix, scale in SCALES.items()
    }
    longest_delay_s = max(span.torque_delay[1] for span in spans.values())
    physics = setup.physics("terrain", longest_delay_s)
    starts, metrics = setup.starts(agent, LIMIT_PHASES, longest_delay_s), []
    for quantity, span in spans.items():
        trials = drawn_trials(span, round(1 / physics.model.opt.timestep))
        result = run_trials(agent, physics, starts, trials, setup.progress, setup.num_envs)
        metrics.append(Metric(quantity, float((~result.fell).mean()), "1", ROBOTS))
    return SuiteResult(metrics)


def drawn_trials(span: DynamicsRange, physics_hz: float) -> list[Trial]:
    """Of 200 robots drawn from the range with seed 0, 10 s each, from one phase of the stride after the other."""
    robots, slope = jax.tree.map(np.asarray, draw_dynamics(span, jax.random.key(0), ROBOTS, physics_hz))
    return [
        Trial(
            robot % len(LIMIT_PHASES),
            WALK_S,
            slope=tuple(slope[robot].tolist()),
            dynamics=jax.tree.map(itemgetter(robot), robots),
        )
        for robot in range(ROBOTS)
    ]
