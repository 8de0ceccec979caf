"""Robots in steady walking, which is where trials start."""

from collections.abc import Iterator, Sequence
from itertools import count, islice

import jax
import numpy as np

from cassie_mjx.agents.types import Agent, AgentState, sense
from cassie_mjx.envs.termination import has_fallen
from cassie_mjx.evaluation.simulate import act_steps, simulate
from cassie_mjx.evaluation.trial import NeverSteady, moved
from cassie_mjx.motion.reference import nearest_sample
from cassie_mjx.physics.types import Physics, Scenario
from cassie_mjx.robot.cassie import PELVIS_Z

WARM_UP_STRIDES = 9


def begin(agent: Agent, physics: Physics, qpos: np.ndarray, qvel: np.ndarray) -> AgentState:
    """Robots that begin to walk from the states qpos [B, 35] and qvel [B, 32]."""
    state = physics.init(qpos, qvel)
    return AgentState(state, agent.init(sense(agent, physics, state, Scenario.nominal(len(qpos)))))


def walk_on(
    agent: Agent, physics: Physics, robots: AgentState, scenario: Scenario | None = None
) -> Iterator[AgentState]:
    """Robots that walk on without end, as they are before each step of the agent; undisturbed by default."""
    scenario = scenario or Scenario.nominal(len(robots.physics.qpos), kd_scale=np.asarray(agent.kd_scale))
    steps = act_steps(agent, physics)
    return (moment.robots for moment in simulate(agent, physics, robots, scenario, count(0, steps)))


def side_by_side(agent: Agent, robots: Sequence[AgentState]) -> AgentState:
    """All `robots` in one batch, the first ones first, each carried back to x = 0."""
    together = jax.tree.map(lambda *leaves: np.concatenate(leaves), *robots)
    return moved(agent, together, -together.physics.qpos[:, :3] * np.array([1.0, 0.0, 0.0]))


def steady(agent: Agent, physics: Physics, phases: np.ndarray) -> AgentState:
    """Robots in steady walking along +x, with the pelvis at x = 0, at `phases` [B] of the stride, 0 to 1.

    One robot walks nine strides from where the agent begins, and is copied along the tenth.

    Raises:
      NeverSteady: it falls before.
    """
    lead = agent.lead
    acts = lead.acts_before(WARM_UP_STRIDES) + nearest_sample(phases, lead.stride_acts)
    walk = enumerate(islice(walk_on(lead, physics, begin(lead, physics, *lead.initial_state(1))), acts.max() + 1))
    taken = {act: robots for act, robots in walk if act in acts}
    robots = side_by_side(lead, [taken[act] for act in acts.tolist()])
    if has_fallen(robots.physics.qpos[:, PELVIS_Z]).any():
        raise NeverSteady(f"{agent.name} falls before it walks steadily, so there is nothing to measure.")
    return AgentState(robots.physics, agent.take_over(robots.carry))
