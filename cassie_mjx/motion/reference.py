"""The reference motion: one stride of states to be imitated; sampled, stretched, blended, saved and loaded.

A stride is two footsteps, sampled once a control step. Frames are MuJoCo's: pelvis position and linear velocity in the
world, its angular velocity in the pelvis; the walk goes along the world's x.
"""

from dataclasses import dataclass
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np

from cassie_mjx.physics.types import Array
from cassie_mjx.robot import cassie

MAX_STRETCH = 4.0
RAMP_PER_S = 0.625
"""Pace at which a walk is brought to another speed, 1/s, in multiples of the stride's: lambda = 1 - 0.625 t between
neighbours of 0x, 1x, 2x, ... (Xie et al. 2018)."""

_X, _Z = (int(cassie.qpos_index("pelvis")[i]) for i in (0, 2))
_VX = int(cassie.qvel_index("pelvis")[0])
_QUATERNION_NAMES = ("pelvis", "left-achilles-rod", "right-achilles-rod")
_QUATERNIONS = np.stack([cassie.qpos_index(name)[-4:] for name in _QUATERNION_NAMES])
# The quaternion that a coordinate belongs to; the number after the last for the coordinates of none.
_QUATERNION_OF = np.full(cassie.NQ, len(_QUATERNIONS))
_QUATERNION_OF[_QUATERNIONS] = np.arange(len(_QUATERNIONS))[:, None]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ReferenceMotion:
    """One periodic stride, sample k at k 0.032 s; sample N is sample 0 again, `stride_length` further along x.

    Attributes:
      qpos: states of the robot, [N, 35], in MuJoCo's order: m, unit quaternions w x y z, rad.
      qvel: their velocities, [N, 32]: m/s world frame, rad/s body frame for the pelvis, rad/s for the joints.
      stride_length: what pelvis x gains in a stride, [], m.
    """

    qpos: Array
    qvel: Array
    stride_length: Array


def sample(motion: ReferenceMotion, phase: Array, stride: Array) -> tuple[Array, Array]:
    """The reference at whole control steps: (qpos [B, 35], qvel [B, 32]).

    Args:
      motion: the stride, NumPy or JAX.
      phase: control steps since the stride began, [B], integers; beyond 0..N-1 it wraps and carries into `stride`.
      stride: strides completed before, [B], integers; each has taken pelvis x `stride_length` forward.
    """
    xp = _namespace(motion.qpos, phase, stride)
    samples = motion.qpos.shape[0]
    qpos, qvel = (xp.asarray(states)[phase % samples] for states in (motion.qpos, motion.qvel))
    # x(k + n N) = x(k) + n L
    laps = xp.asarray(stride + phase // samples, qpos.dtype)
    advance = laps * xp.asarray(motion.stride_length, qpos.dtype)
    return qpos + advance[..., None] * xp.asarray(np.arange(cassie.NQ) == _X, qpos.dtype), qvel


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
      ValueError: a factor outside 0..4, the range of the paper.
    """
    if not 0 <= factor <= MAX_STRETCH:
        raise ValueError(f"A reference cannot be stretched by {factor}; use a factor from 0 to {MAX_STRETCH:g}.")
    return ReferenceMotion(*stretch_states(motion.qpos, motion.qvel, factor), motion.stride_length * factor)


def stretch_states(qpos: Array, qvel: Array, factor: Array) -> tuple[Array, Array]:
    """States [..., 35] and [..., 32] of a motion at `factor` [...] times its speed; a factor of 1 changes no bit."""
    xp = _namespace(qpos, factor)
    scale_q, scale_v = (
        xp.where(np.arange(states.shape[-1]) == column, xp.asarray(factor, states.dtype)[..., None], 1)
        for states, column in ((qpos, _X), (qvel, _VX))
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
    xp = _namespace(a, b, lam)
    ones = xp.ones_like(a[..., :1])
    dots = xp.sum(a[..., _QUATERNIONS] * b[..., _QUATERNIONS], axis=-1)
    sign = xp.concatenate([xp.where(dots < 0, -ones, ones), ones], axis=-1)[..., _QUATERNION_OF]
    mixed = lam * a + (1 - lam) * sign * b
    norms = xp.linalg.norm(mixed[..., _QUATERNIONS], axis=-1)
    return mixed / xp.concatenate([norms, ones], axis=-1)[..., _QUATERNION_OF]


def _namespace(*arrays: Array) -> ModuleType:
    return jnp if any(isinstance(array, jax.Array) for array in arrays) else np
