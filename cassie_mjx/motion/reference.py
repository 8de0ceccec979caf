"""The reference motion: states to be imitated, sampled once a control step, for NumPy and JAX arrays alike.

Frames are MuJoCo's: pelvis position and linear velocity in the world, its angular velocity in the pelvis; the motion
goes along the x axis of the path that a command describes. With the command straight ahead that is the world's frame.
"""

from typing import NamedTuple

import numpy as np

from cassie_mjx.motion.command import FASTEST, Command
from cassie_mjx.robot import cassie
from cassie_mjx.robot.arrays import Array, namespace
from cassie_mjx.robot.cassie import CONTROL_PERIOD_S, PELVIS_X
from cassie_mjx.robot.rotation import up_in_body

RAMP_PER_S = 0.625
"""Pace at which a walk is brought to another speed, 1/s, in multiples of the stride's: lambda = 1 - 0.625 t between
neighbours of 0x, 1x, 2x, ... (Xie et al. 2018)."""

VELOCITY_X, VELOCITY_Y, _ = cassie.PELVIS_VELOCITY.tolist()
QUATERNION_NAMES = ("pelvis", "left-achilles-rod", "right-achilles-rod")
QUATERNIONS = np.stack([cassie.qpos_index(name)[-4:] for name in QUATERNION_NAMES])
"""Where qpos has each of these quaternions, [3, 4]."""
# The quaternion that a coordinate belongs to; the number after the last for the coordinates of none.
_QUATERNION_OF = np.full(cassie.NQ, len(QUATERNIONS))
_QUATERNION_OF[QUATERNIONS] = np.arange(len(QUATERNIONS))[:, None]


class ReferenceMotion(NamedTuple):
    """States of the robot every 0.032 s: a stride that repeats, or a motion that ends."""

    qpos: Array
    """[N, 35], in MuJoCo's order: m, unit quaternions w x y z, rad."""
    qvel: Array
    """[N, 32], their velocities: m/s world frame, rad/s body frame for the pelvis, rad/s for the joints."""
    stride_length: Array
    """What pelvis x gains from one repetition to the next, or from the first sample to the last, [], m."""
    periodic: bool = True
    """Whether sample N is sample 0 again, `stride_length` further along x. Else it stays in its last state."""


def mean_speed(motion: ReferenceMotion) -> Array:
    """Mean forward speed of a motion, m/s."""
    return motion.stride_length / (motion.qpos.shape[0] * CONTROL_PERIOD_S)


def sample(motion: ReferenceMotion, time: Array, command: Command | None = None) -> tuple[Array, Array]:
    """The reference at whole control steps, in the frame of the path: (qpos [B, 35], qvel [B, 32]).

    Args:
      motion: NumPy or JAX.
      time: control steps since the start of the motion, [B], integers, also negative ones.
      command: of the robots; the motion's own speed unless given. Forward, pelvis x and its velocity are
        stretched (Xie et al. 2018): x'(t) = v' / v x(t). The lateral velocity and the yaw rate are those of the path
        (`control.path.bend`): they are added to the pelvis' velocities, and no place in the path's frame changes.
        Robots that stand are in the published standing pose; in between, in a mixture of it and the motion.
    """
    xp = namespace(motion.qpos, time)
    samples = motion.qpos.shape[0]
    phase, laps = time % samples, time // samples
    if motion.periodic is not True:
        phase = xp.where(motion.periodic, phase, xp.clip(time, 0, samples - 1))
        laps = xp.where(motion.periodic, laps, 0)
    qpos, qvel = (xp.asarray(states)[phase] for states in (motion.qpos, motion.qvel))
    # x(k + n N) = x(k) + n L
    advance = xp.asarray(laps, dtype=qpos.dtype) * xp.asarray(motion.stride_length, dtype=qpos.dtype)
    qpos = qpos + advance[..., None] * xp.asarray(np.arange(cassie.NQ) == PELVIS_X, dtype=qpos.dtype)
    if command is None:
        return qpos, qvel
    qpos, qvel = stretch_states(qpos, qvel, speed_ratio(motion, command))
    return _standing(qpos, _steered(qpos, qvel, command), command.stand)


def _standing(qpos: Array, qvel: Array, stand: Array | float) -> tuple[Array, Array]:
    """States [B, 35] and [B, 32] of robots that stand, from 0, which changes no bit, to 1, [B]; x stays."""
    xp = namespace(qpos, stand)
    share = xp.asarray(stand, dtype=qpos.dtype)[..., None]
    pose = xp.where(np.arange(cassie.NQ) == PELVIS_X, qpos, xp.asarray(cassie.STANDING_QPOS, dtype=qpos.dtype))
    return xp.where(share > 0, mix_qpos(pose, qpos, share), qpos), (1 - share) * qvel


def _steered(qpos: Array, qvel: Array, command: Command) -> Array:
    """Velocities [B, 32] of a reference at qpos [B, 35], with those of the path; straight ahead no bit changes."""
    xp = namespace(qvel, command.lateral)
    lateral, yaw_rate = (xp.asarray(told, dtype=qvel.dtype)[..., None] for told in (command.lateral, command.yaw_rate))
    first, *_, last = cassie.PELVIS_ANGULAR_VELOCITY
    # omega_B = omega_B + psi' R^T e_z
    turning = qvel[..., first : last + 1] + yaw_rate * up_in_body(qpos[..., cassie.PELVIS_QUATERNION])
    aside = qvel[..., VELOCITY_Y : VELOCITY_Y + 1] + lateral
    before, between, after = qvel[..., :VELOCITY_Y], qvel[..., VELOCITY_Y + 1 : first], qvel[..., last + 1 :]
    return xp.concatenate([before, aside, between, turning, after], axis=-1)


def speed_ratio(motion: ReferenceMotion, command: Command) -> Array:
    """The commanded speed over the motion's own, [B]: exactly 1 if they are the same; 1 for a motion on the spot."""
    xp = namespace(motion.qpos, command.forward)
    own = xp.asarray(mean_speed(motion))
    forward = xp.asarray(command.forward)
    return xp.where((forward == own) | (own == 0), xp.ones_like(forward), forward / xp.where(own == 0, 1, own))


def nearest_sample(phase: Array, samples: int) -> np.ndarray:
    """The whole control step nearest to a phase of the stride, [...], the later one of two that are as near.

    Half a stride later is then half the samples later: 6/8 of 22 samples is 11 after 2/8.

    Args:
      phase: fraction of the stride, [...].
      samples: N, control steps of the stride.
    """
    return np.floor(np.asarray(phase) * samples + 0.5).astype(np.int32)


def stretch(motion: ReferenceMotion, factor: float) -> ReferenceMotion:
    """The same motion at `factor` times the speed: pelvis x and its velocity are scaled, nothing else.

    Raises:
      ValueError: a factor that is negative or not finite.
    """
    if not 0 <= factor < np.inf:
        raise ValueError(f"A reference cannot be stretched by {factor}; use a factor from 0 to {FASTEST:g}.")
    qpos, qvel = stretch_states(motion.qpos, motion.qvel, factor)
    return motion._replace(qpos=qpos, qvel=qvel, stride_length=motion.stride_length * factor)


def stretch_states(qpos: Array, qvel: Array, factor: Array | float) -> tuple[Array, Array]:
    """States [..., 35] and [..., 32] of a motion at `factor` [...] times its speed; a factor of 1 changes no bit."""
    xp = namespace(qpos, factor)
    scale_q, scale_v = (
        xp.where(np.arange(states.shape[-1]) == column, xp.asarray(factor, dtype=states.dtype)[..., None], 1)
        for states, column in ((qpos, PELVIS_X), (qvel, VELOCITY_X))
    )
    return qpos * scale_q, qvel * scale_v


def blend_motions(a: ReferenceMotion, b: ReferenceMotion, lam: Array) -> ReferenceMotion:
    """The motion lambda a + (1 - lambda) b, phase by phase; quaternions along the shorter way, renormalised.

    Args:
      a: the motion at lam = 1.
      b: the motion at lam = 0, with as many samples.
      lam: lambda, 0..1, a number or an array [].

    Raises:
      ValueError: strides of different numbers of samples.
    """
    if a.qpos.shape != b.qpos.shape:
        raise ValueError(
            f"Motions of {a.qpos.shape[0]} and {b.qpos.shape[0]} samples cannot be blended phase by phase; "
            "resample one of them."
        )
    return ReferenceMotion(
        mix_qpos(a.qpos, b.qpos, lam),
        lam * a.qvel + (1 - lam) * b.qvel,
        lam * a.stride_length + (1 - lam) * b.stride_length,
    )


def mix_qpos(a: Array, b: Array, lam: Array) -> Array:
    """The configurations lambda a + (1 - lambda) b, [..., 35]; quaternions along the shorter way, renormalised."""
    xp = namespace(a, b, lam)
    ones = xp.ones_like(a[..., :1])
    dots = xp.sum(a[..., QUATERNIONS] * b[..., QUATERNIONS], axis=-1)
    sign = xp.concatenate([xp.where(dots < 0, -ones, ones), ones], axis=-1)[..., _QUATERNION_OF]
    mixed = lam * a + (1 - lam) * sign * b
    norms = xp.linalg.norm(mixed[..., QUATERNIONS], axis=-1)
    return mixed / xp.concatenate([norms, ones], axis=-1)[..., _QUATERNION_OF]


def aligned(motion: ReferenceMotion) -> ReferenceMotion:
    """The same motion with quaternions whose sign, which means nothing, never jumps and begins with w >= 0."""
    xp = namespace(motion.qpos)
    quaternions = motion.qpos[:, QUATERNIONS]
    ones = xp.ones_like(motion.qpos[:, :1])
    neighbours = xp.sum(quaternions[1:] * quaternions[:-1], axis=-1)
    kept = xp.concatenate([quaternions[:1, :, 0], neighbours]) >= 0
    sign = xp.cumprod(xp.where(kept, ones, -ones), axis=0)
    return motion._replace(qpos=motion.qpos * xp.concatenate([sign, ones], axis=-1)[:, _QUATERNION_OF])


def steps_mirror(motion: ReferenceMotion, tolerance: float = 1e-3) -> bool:
    """Whether the second half of a stride is the mirror image of the first, to `tolerance` in every coordinate."""
    samples = motion.qpos.shape[0]
    if samples % 2 or not motion.periodic:
        return False
    qpos, qvel = np.array(motion.qpos, float), np.array(motion.qvel, float)
    first, second = np.split(qpos, 2)
    first_v, second_v = np.split(qvel, 2)
    image = cassie.mirror_qpos(first)
    image[:, PELVIS_X] += second[0, PELVIS_X] - first[0, PELVIS_X]
    close = np.allclose(image, second, atol=tolerance)
    return close and np.allclose(cassie.mirror_qvel(first_v), second_v, atol=10 * tolerance)
