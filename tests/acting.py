"""Agents for tests: what an agent must have, and one that needs a robot but no walk."""

import jax.numpy as jnp
import numpy as np

from cassie_mjx.agents.types import AgentState
from cassie_mjx.evaluation.steady import begin
from cassie_mjx.ppo import networks
from cassie_mjx.robot import cassie
from cassie_mjx.robot.model import ModelConfig, load_model, standing


def mode(policy, observation):
    """What a learner's policy without memory does."""
    return networks.mode(policy, observation, jnp.zeros((*observation.shape[:-1], 0)))[0]


class TestAgent:
    """Every robot carries one number, how often it acted."""

    __test__ = False
    name, period_s, kd_scale, needs_bodies, motion, stride_acts = "test", 0.032, 1.0, False, None, 22

    def __init__(self):
        self.provenance = {}

    @property
    def lead(self):
        return self

    def acts_before(self, stride):
        return 0

    def initial_state(self, robots):
        return np.tile(standing(load_model(ModelConfig())), (robots, 1)), np.full((robots, cassie.NV), 0.02)

    def init(self, sensed):
        return np.zeros(len(sensed.qpos))

    def start(self, physics, phases) -> AgentState:
        return begin(self, physics, *self.initial_state(len(phases)))

    def step(self, carry, sensed, command):
        return np.zeros((len(carry), cassie.NU)), carry + 1

    def moved(self, carry, offset):
        return carry

    def take_over(self, carry):
        return carry


class Swaying(TestAgent):
    """It holds the standing pose, and gives way to how fast it senses itself move."""

    name = "swaying"

    def __init__(self, period_s=0.032, hold=1.0, kd_scale=1.0):
        super().__init__()
        self.period_s, self.hold, self.kd_scale = period_s, hold, kd_scale

    def step(self, carry, sensed, command):
        sway = 0.02 * sensed.qvel[:, cassie.ACTIVE_QVEL] + 0.01 * np.sin(carry)[:, None]
        return self.hold * cassie.STANDING_TARGET + sway, carry + 1
