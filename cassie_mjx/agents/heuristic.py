"""The heuristic walker as an agent."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np

from cassie_mjx.evaluation.steady import WARM_UP_STRIDES, copied_along
from cassie_mjx.evaluation.trial import Measured, Walker
from cassie_mjx.heuristic import law
from cassie_mjx.heuristic.config import CONTROLLERS, ControllerConfig
from cassie_mjx.heuristic.law import ControllerState
from cassie_mjx.motion.reference import nearest_sample
from cassie_mjx.physics.types import Array, BodyState, Physics, PhysicsState
from cassie_mjx.robot import cassie
from cassie_mjx.robot.model import standing

CONTROLLER_PREFIX = "controller:"


class HeuristicCarry(NamedTuple):
    """What a robot of a `HeuristicAgent` carries: leaves [B]."""

    config: ControllerConfig
    state: ControllerState


class HeuristicAgent:
    """Heuristic walkers as a `Subject`; phase 0 of their stride is where the left leg takes over.

    Every robot carries its parameters with it, so that robots of different parameters can walk side by side.
    """

    def __init__(self, name: str, config: ControllerConfig | None = None) -> None:
        """Take the controller `name` of `CONTROLLERS`.

        Args:
          name: of the preset, which also gives period and step time.
          config: other parameters than the preset's; leaves [B] for the B robots of `begin`, or [].
        """
        self.name, self.damping = CONTROLLER_PREFIX + name, 1.0
        self.provenance: Mapping[str, Any] = {}
        preset = CONTROLLERS[name]
        self.config = config or preset
        self.period_s = preset.period
        self.stride_calls = 2 * round(preset.step_time / preset.period)

    def begin(self, physics: Physics, qpos: np.ndarray, qvel: np.ndarray) -> Walker:
        """Robots that begin to walk from the states qpos [B, 35] and qvel [B, 32]."""
        state = physics.init(qpos, qvel)
        config = jax.tree.map(lambda leaf: np.broadcast_to(np.float32(leaf), len(qpos)), self.config)
        return Walker(state, HeuristicCarry(config, law.init(config, state.qpos, physics.bodies(state))))

    def stand(self, physics: Physics, robots: int) -> Walker:
        """Robots that begin to walk from standing still."""
        return self.begin(physics, np.tile(standing(physics.model), (robots, 1)), np.zeros((robots, cassie.NV)))

    def calls_before(self, stride: int) -> int:
        """Acts between `begin` and phase 0 of a stride: the walk begins with half a step on the right leg."""
        return self.stride_calls // 4 + stride * self.stride_calls

    def start(self, physics: Physics, phases: np.ndarray) -> Walker:
        """See `Subject.start`: one robot walks nine strides from standing, and is copied along the tenth."""
        calls = self.calls_before(WARM_UP_STRIDES) + nearest_sample(phases, self.stride_calls)
        return copied_along(self, physics, self.stand(physics, 1), calls)

    def returns(self, physics: Physics, delay: int = 0) -> list[Measured]:
        """See `Subject.returns`: a controller imitates nothing, so it has none."""
        return []

    def act(self, physics: Physics, seen: PhysicsState, memory: HeuristicCarry) -> tuple[Array, HeuristicCarry]:
        """See `Subject.act`."""
        return _controller_act(memory, seen.qpos, seen.qvel, physics.bodies(seen), self.period_s)

    def carried(self, memory: HeuristicCarry, offset: np.ndarray) -> HeuristicCarry:
        """See `Subject.carried`."""
        along = offset * np.array([1.0, 1.0, 0.0])
        state = memory.state
        return memory._replace(state=replace(state, liftoff_w=state.liftoff_w + offset, line_w=state.line_w + along))


@jax.jit
def _controller_act(
    memory: HeuristicCarry, qpos: Array, qvel: Array, bodies: BodyState, period_s: float
) -> tuple[Array, HeuristicCarry]:
    target, state = law.step(memory.config, memory.state, qpos, qvel, bodies, period_s)
    return target, memory._replace(state=state)
