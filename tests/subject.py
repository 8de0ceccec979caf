"""A subject for tests that need a robot but no walk."""

import numpy as np

from cassie_mjx.agents.types import AgentState
from cassie_mjx.robot import cassie
from cassie_mjx.robot.model import standing


class Swaying:
    """It holds the standing pose, gives way to how fast it sees itself move, and remembers how often it acted."""

    name = "swaying"

    def __init__(self, period_s=0.032, hold=1.0, kd_scale=1.0):
        self.provenance, self.period_s, self.hold, self.kd_scale = {}, period_s, hold, kd_scale

    def start(self, physics, phases):
        qpos = np.tile(standing(physics.model), (len(phases), 1))
        qvel = np.full((len(phases), cassie.NV), 0.02)
        return AgentState(physics.init(qpos, qvel), np.zeros(len(phases)))

    def returns(self, physics, delay=0):
        return []

    def act(self, physics, seen, memory):
        sway = 0.02 * seen.qvel[:, cassie.ACTIVE_QVEL] + 0.01 * np.sin(memory)[:, None]
        return self.hold * cassie.STANDING_TARGET + sway, memory + 1

    def moved(self, memory, offset):
        return memory
