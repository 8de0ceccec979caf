"""An engine of points and an agent that does nothing, with which trials have outcomes written down beforehand."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
from acting import TestAgent

from cassie_mjx.agents.types import AgentState
from cassie_mjx.physics.types import PhysicsState
from cassie_mjx.robot import cassie
from cassie_mjx.robot.arrays import namespace


def never(start, velocity, t, scenario):
    return t < 0


class _Points:
    """Points that slide along x with acceleration `pull`.

    `falls(start, velocity, t, scenario)` says which are down: true, false or NaN.
    """

    max_delay, traceable = 0, False

    def __init__(self, hertz=2000, pull=0.0, falls=never):
        self.model = SimpleNamespace(opt=SimpleNamespace(timestep=1 / hertz), nu=10)
        self.pull, self.falls = pull, falls
        self.flown = 0

    def advance(self, state, target, scenario, n_steps):
        xp, dt = namespace(state.qpos), self.model.opt.timestep
        self.flown += n_steps * len(target)
        step = state.step + np.int32(n_steps)
        first, last = xp.maximum(scenario.push_start.T, state.step), xp.minimum(scenario.push_stop.T, step)
        gained = ((last - first).clip(0).T[..., None] * dt * scenario.push).sum(axis=1)
        t = step * dt
        qvel = xp.concatenate([state.qvel[:, :3] + gained, state.qvel[:, 3:]], 1)
        down = self.falls(state.qpos[:, -1], qvel[:, :3], t, scenario)
        x, y, z = self.pull * t**2 / 2, state.qpos[:, 1], 0.9 - 0.4 * down
        qpos = xp.concatenate([xp.stack([x, y, z], 1), state.qpos[:, 3:]], 1)
        return replace(state, qpos=qpos, qvel=qvel, step=step)


class _CompiledPoints(_Points):
    """The same as an engine of compiled calls."""

    traceable = True


def points(**how) -> Any:
    """The engine, typed as any."""
    return _Points(**how)


def compiled_points(**how) -> Any:
    """The engine, typed as any, that is advanced as MJX is."""
    return _CompiledPoints(**how)


class Still(TestAgent):
    """An agent that asks for zero angles."""

    name = "still"

    def start(self, physics, phases):
        robots = len(phases)
        qpos = np.zeros((robots, cassie.NQ))
        qpos[:, 2], qpos[:, 3], qpos[:, -1] = 0.9, 1.0, np.arange(robots)
        zero = np.zeros((robots, cassie.NV))
        state = PhysicsState(qpos, zero, zero, np.zeros(robots, np.int32), np.zeros((robots, 0, 67)))
        return AgentState(state, np.zeros(robots))
