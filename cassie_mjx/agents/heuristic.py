"""The heuristic controller as an agent."""

import functools
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np

from cassie_mjx.agents.types import Sensed
from cassie_mjx.heuristic import law
from cassie_mjx.heuristic.config import CONTROLLERS, ControllerConfig
from cassie_mjx.heuristic.law import ControllerState
from cassie_mjx.heuristic.pendulum import Masses
from cassie_mjx.motion.command import Command
from cassie_mjx.robot import cassie
from cassie_mjx.robot.arrays import Array
from cassie_mjx.robot.model import ModelConfig, load_model, standing

CONTROLLER_PREFIX = "controller:"


class HeuristicCarry(NamedTuple):
    """What a robot of a `HeuristicAgent` carries: leaves [B]."""

    config: ControllerConfig
    state: ControllerState


class HeuristicAgent:
    """Heuristic controllers as an `Agent`; phase 0 of their stride is where the left leg takes over.

    Every robot carries its parameters with it, so that robots of different parameters can walk side by side.
    """

    needs_bodies, motion, kd_scale = True, None, 1.0

    def __init__(self, name: str, config: ControllerConfig | None = None) -> None:
        """Take the controller `name` of `CONTROLLERS`.

        Args:
          name: of the preset, which also gives period and step time.
          config: other parameters than the preset's; leaves [B] for the B robots of `init`, or [].
        """
        self.name = CONTROLLER_PREFIX + name
        self.provenance: Mapping[str, Any] = {}
        preset = CONTROLLERS[name]
        self.config = config or preset
        self.period_s = preset.period
        self._stride_acts = 2 * round(preset.step_time / preset.period)
        self._step = jax.jit(partial(_step, Masses.of(_model())))

    @property
    def lead(self) -> "HeuristicAgent":
        """See `Agent.lead`."""
        return self

    @property
    def stride_acts(self) -> int:
        """See `Agent.stride_acts`."""
        return self._stride_acts

    def acts_before(self, stride: int) -> int:
        """See `Agent.acts_before`: the walk begins with half a step on the right leg."""
        return self.stride_acts // 4 + stride * self.stride_acts

    def initial_state(self, robots: int) -> tuple[np.ndarray, np.ndarray]:
        """See `Agent.initial_state`: standing still."""
        return np.tile(standing(_model()), (robots, 1)), np.zeros((robots, cassie.NV))

    def init(self, sensed: Sensed) -> HeuristicCarry:
        """See `Agent.init`."""
        config = jax.tree.map(lambda leaf: np.broadcast_to(np.float32(leaf), len(sensed.qpos)), self.config)
        assert sensed.bodies is not None
        return HeuristicCarry(config, law.init(config, sensed.qpos, sensed.bodies))

    def step(self, carry: HeuristicCarry, sensed: Sensed, command: Command | None) -> tuple[Array, HeuristicCarry]:
        """See `Agent.step`: it has one speed, that of its parameters."""
        return self._step(carry, sensed, self.period_s)

    def moved(self, carry: HeuristicCarry, offset: np.ndarray) -> HeuristicCarry:
        """See `Agent.moved`."""
        along = offset * np.array([1.0, 1.0, 0.0])
        state = carry.state
        return carry._replace(state=replace(state, liftoff_w=state.liftoff_w + offset, line_w=state.line_w + along))

    def take_over(self, carry: HeuristicCarry) -> HeuristicCarry:
        """See `Agent.take_over`."""
        return carry


@functools.cache
def _model() -> mujoco.MjModel:
    return load_model(ModelConfig())


def _step(masses: Masses, carry: HeuristicCarry, sensed: Sensed, period_s: float) -> tuple[Array, HeuristicCarry]:
    assert sensed.bodies is not None
    target, state = law.step(carry.config, masses, carry.state, sensed.qpos, sensed.qvel, sensed.bodies, period_s)
    return target, carry._replace(state=state)
