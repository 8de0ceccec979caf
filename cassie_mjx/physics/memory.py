"""What an engine with delay or electronics remembers from one physics step to the next, and torques that are late."""

from typing import NamedTuple

import mujoco
import numpy as np

from cassie_mjx.physics.types import PhysicsState, Scenario, begin_history
from cassie_mjx.robot import cassie, electronics
from cassie_mjx.robot.arrays import Array, namespace
from cassie_mjx.robot.electronics import Electronics, cycles_per_step, torque_delay_steps


class Rhythm(NamedTuple):
    """How the electronics of an engine go with its physics steps."""

    cycles: int = 0
    """Cycles in a physics step; 0 without electronics."""
    torque_delay: int = 0
    """How late torques are where robots do not differ, physics steps."""


def rhythm(model: mujoco.MjModel, electronics: bool, max_delay: int) -> Rhythm:
    """That of an engine with this model, made for delays of up to `max_delay` physics steps.

    Raises:
      ValueError: a physics step has no whole number of cycles, or torques are later than the engine is made for.
    """
    if not electronics:
        return Rhythm()
    hertz = 1 / model.opt.timestep
    found = Rhythm(cycles_per_step(hertz), torque_delay_steps(hertz))
    if found.torque_delay > max_delay:
        raise ValueError(
            f"max_delay={max_delay} has no room for the torque delay of the electronics; "
            f"it must be {found.torque_delay} or more."
        )
    return found


def begin_memory(qpos: Array, qvel: Array, max_delay: int, rhythm: Rhythm) -> tuple[Array, Electronics | None]:
    """History and electronics of robots that have always been in the state qpos [B, 35], qvel [B, 32]."""
    if not rhythm.cycles:
        return begin_history(qpos, qvel, max_delay), None
    memory = electronics.init(qpos, qvel)
    return begin_history(*electronics.shown(memory, qpos, qvel), max_delay), memory


def remembered(
    before: PhysicsState, qpos: Array, qvel: Array, torque: Array, rhythm: Rhythm
) -> tuple[Array, Electronics | None]:
    """What is remembered after a physics step: the row of the history, [B, 77], and the electronics.

    Args:
      before: the state that the step began in.
      qpos: after it, [B, 35].
      qvel: after it, [B, 32].
      torque: asked for in it, [B, 10], N·m.
      rhythm: of the engine.
    """
    memory = before.electronics
    if memory is not None:
        memory = electronics.update(memory, before.qpos, qpos, rhythm.cycles)
        qpos, qvel = electronics.shown(memory, qpos, qvel)
    return namespace(qpos).concatenate([qpos, qvel, torque], axis=1), memory


def late_torque(state: PhysicsState, torque: Array, scenario: Scenario, usual: int = 0) -> Array:
    """Torques that act in this physics step, [B, 10], N·m, where those of `torque` [B, 10] are asked for.

    They are as old as the torque delay of the scenario's dynamics or, where that has none, the `usual` one, physics
    steps. Until that time has passed since the start, none is late.
    """
    slots, dynamics, xp = state.history.shape[1], scenario.dynamics, namespace(torque)
    if slots == 0 or (dynamics is None and not usual):
        return torque
    drawn = np.int32(-1) if dynamics is None else dynamics.torque_delay
    late = xp.where(drawn < 0, usual, drawn)
    old = state.history[np.arange(len(torque)), (state.step + 1 - late) % slots, -cassie.NU :]
    return xp.where(((late == 0) | (state.step < late))[:, None], torque, old)
