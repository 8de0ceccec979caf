"""Cassie's electronics: what encoders and their filters show of the joints, and what motors give at a speed.

Figures and filters are those by which the robot's maker simulates them, at 2 kHz (osudrl/cassie-mujoco-sim). Array
functions for NumPy and JAX alike, over robots (axis B). Gyro and orientation are shown as they are.
"""

from typing import NamedTuple

import numpy as np

from cassie_mjx.robot import cassie
from cassie_mjx.robot.arrays import Array, namespace

CYCLE_HZ = 2000
"""Cycles of the electronics a second."""
TORQUE_DELAY_CYCLES = 6
"""Cycles from the torque that is asked for to the one that acts: 3 ms."""
MOTOR_BITS = np.tile([13, 13, 13, 13, 18], 2)
"""Of the encoders of motors, for a turn of the motor."""
JOINT_BITS = 18
"""Of the encoders of shins and tarsi, for a turn of the joint."""
NO_LOAD_RPM = np.tile([2900.0, 2900.0, 1300.0, 1300.0, 5500.0], 2)
"""Speeds of the motors at which they have no torque left, turns a minute."""

_MOTOR_TAPS = np.array([2727, 534, -2658, -795, 72, 110, 19, -6, -3], np.int32)
_FULL = 2**30
_MOTOR_SCALE = 2 * np.pi / 2.0**MOTOR_BITS / cassie.GEAR
_JOINT_SCALE = 2 * np.pi / 2.0**JOINT_BITS
_NO_LOAD = NO_LOAD_RPM * 2 * np.pi / 60 / cassie.GEAR
_SPRUNG_QPOS, _SPRUNG_QVEL = cassie.qpos_index(*cassie.SPRUNG_NAMES), cassie.qvel_index(*cassie.SPRUNG_NAMES)
_ENCODER_QVEL = cassie.qvel_index(*cassie.ENCODERS)


class Electronics(NamedTuple):
    """What encoders and filters remember, newest first."""

    counts: Array
    """Of the motors' encoders, [B, 9, 10], int32."""
    angles: Array
    """That the encoders of shins and tarsi showed, [B, 4, 4], rad."""
    speeds: Array
    """That the filters of shins and tarsi made of them, [B, 2, 4], rad/s."""


def init(qpos: Array, qvel: Array) -> Electronics:
    """The memory of robots that have always moved as they do at qpos [B, 35], qvel [B, 32].

    At rest, the filters are filled with the first count, as the maker's are.
    """
    xp = namespace(qpos)

    def before(cycle: int, places: np.ndarray, speeds: np.ndarray) -> Array:
        return qpos[:, places] - cycle / CYCLE_HZ * qvel[:, speeds]

    counts = [_counts(before(cycle, cassie.ACTIVE_QPOS, cassie.ACTIVE_QVEL)) for cycle in range(len(_MOTOR_TAPS))]
    angles = [_angles(before(cycle, _SPRUNG_QPOS, _SPRUNG_QVEL)) for cycle in range(4)]
    speeds = 2 * [qvel[:, _SPRUNG_QVEL]]
    return Electronics(*(xp.stack(each, axis=1) for each in (counts, angles, speeds)))


def update(memory: Electronics, before: Array, after: Array, cycles: int) -> Electronics:
    """The memory after a physics step of so many cycles, in which robots go evenly from `before` to `after` [B, 35]."""
    for cycle in range(1, cycles + 1):
        memory = _cycle(memory, before + cycle / cycles * (after - before))
    return memory


def shown(memory: Electronics, qpos: Array, qvel: Array) -> tuple[Array, Array]:
    """States qpos [B, 35] and qvel [B, 32] with angles and velocities of the 14 joints as the electronics show them."""
    xp = namespace(qpos)
    counts = memory.counts
    # Differences, for the counts of a foot times a tap do not fit into 32 bits; the taps' sum is 0.
    filtered = ((counts - counts[:, :1]) * _MOTOR_TAPS[:, None]).sum(axis=1)
    angles = xp.concatenate([counts[:, 0] * _MOTOR_SCALE, memory.angles[:, 0]], axis=1)
    speeds = xp.concatenate([filtered * _MOTOR_SCALE / np.pi, memory.speeds[:, 0]], axis=1)
    return _placed(angles, cassie.ENCODER_QPOS, qpos), _placed(speeds, _ENCODER_QVEL, qvel)


def limited(torque: Array, qdot: Array) -> Array:
    """Torques at the joints, [B, 10], N·m, within what motors give at joint velocities [B, 10], rad/s."""
    # |tau| <= clip(2 tau_max (1 - |omega| / omega_max), 0, tau_max)
    limit = (2 * cassie.TORQUE_LIMIT * (1 - abs(qdot) / _NO_LOAD)).clip(0, cassie.TORQUE_LIMIT)
    return namespace(torque, limit).clip(torque, -limit, limit)


def cycles_per_step(physics_hz: float) -> int:
    """Cycles of the electronics in a physics step. Raises ValueError unless that is a whole number."""
    cycles = CYCLE_HZ / physics_hz
    if cycles < 1 or abs(cycles - round(cycles)) > 1e-9:
        raise ValueError(
            f"physics_hz={physics_hz:g} with electronics, whose cycles come at {CYCLE_HZ} Hz: use 500, 1000 or 2000."
        )
    return round(cycles)


def torque_delay_steps(physics_hz: float) -> int:
    """How late torques are, whole physics steps."""
    return round(TORQUE_DELAY_CYCLES / CYCLE_HZ * physics_hz)


def _cycle(memory: Electronics, qpos: Array) -> Electronics:
    xp = namespace(qpos)
    angles = xp.concatenate([_angles(qpos[:, None, _SPRUNG_QPOS]), memory.angles[:, :-1]], axis=1)
    counts = xp.concatenate([_counts(qpos[:, None, cassie.ACTIVE_QPOS]), memory.counts[:, :-1]], axis=1)
    x, y = angles, memory.speeds
    # y_k = 12.348 (x_k + x_k-1 - x_k-2 - x_k-3) + 1.7658 y_k-1 - 0.79045 y_k-2
    change = (x[:, 0] - x[:, 2]) + (x[:, 1] - x[:, 3])
    speed = 12.348 * change + 1.7658 * y[:, 0] - 0.79045 * y[:, 1]
    return Electronics(counts, angles, xp.stack([speed, y[:, 0]], axis=1))


def _counts(angles: Array) -> Array:
    """What the motors' encoders count at joint angles [..., 10], rad: towards 0, and 0 where physics has diverged."""
    xp = namespace(angles)
    turns = xp.where(xp.isfinite(angles), angles, 0.0) / _MOTOR_SCALE
    return xp.trunc(turns).clip(-_FULL, _FULL).astype(np.int32)


def _angles(angles: Array) -> Array:
    """What the encoders of shins and tarsi show of angles [..., 4], rad."""
    return namespace(angles).trunc(angles / _JOINT_SCALE) * _JOINT_SCALE


def _placed(values: Array, places: np.ndarray, state: Array) -> Array:
    """A state [B, n] with values [B, 14] in these places."""
    source, has = np.zeros(state.shape[1], int), np.zeros(state.shape[1], bool)
    source[places], has[places] = np.arange(len(places)), True
    return namespace(state).where(has, values[:, source], state)
