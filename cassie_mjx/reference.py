"""The reference motion: one stride of states to be imitated; sampled, stretched, blended, saved and loaded.

A stride is two footsteps, sampled once a control step. Frames are MuJoCo's: pelvis position and linear velocity in the
world, its angular velocity in the pelvis; the walk goes along the world's x.
"""

import json
import zipfile
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from cassie_mjx import robot
from cassie_mjx.model import CONTROL_PERIOD_S, ModelConfig, close_loops, close_loops_velocity
from cassie_mjx.model import load as load_model
from cassie_mjx.robot import Array

SHIPPED = ("walk",)
MAX_STRETCH = 4.0
RAMP_PER_S = 0.625
"""Pace at which a walk is brought to another speed, 1/s, in multiples of the stride's: lambda = 1 - 0.625 t between
neighbours of 0x, 1x, 2x, ... (Xie et al. 2018)."""

_FORMAT, _VERSION = "cassie-mjx reference motion", 1
_ARRAYS = ("qpos", "qvel", "stride_length")

_X, _Z = (int(robot.qpos_index("pelvis")[i]) for i in (0, 2))
_VX = int(robot.qvel_index("pelvis")[0])
_QUATERNION_NAMES = ("pelvis", "left-achilles-rod", "right-achilles-rod")
_QUATERNIONS = np.stack([robot.qpos_index(name)[-4:] for name in _QUATERNION_NAMES])
# The quaternion that a coordinate belongs to; the number after the last for the coordinates of none.
_QUATERNION_OF = np.full(robot.NQ, len(_QUATERNIONS))
_QUATERNION_OF[_QUATERNIONS] = np.arange(len(_QUATERNIONS))[:, None]

# The public trajectory file: time, qpos, qvel, then motor torques, positions and velocities, 10 each.
_COLUMNS = 98
_TIME, _QPOS, _QVEL = 0, slice(1, 36), slice(36, 68)

# What tells another robot, or no robot, from Cassie: coarse, for recorded motions overshoot the limits a little.
_HEIGHTS_M = (robot.FALL_LOW_M, robot.FALL_HIGH_M)
_BEYOND_LIMIT_RAD = 0.3
_NOT_UNIT = 1e-3
_NOT_PERIODIC_RAD = 0.1
_LONGEST_STRIDE_S = 10.0


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
    return qpos + advance[..., None] * xp.asarray(np.arange(robot.NQ) == _X, qpos.dtype), qvel


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


def blend(a: ReferenceMotion, b: ReferenceMotion, lam: Array) -> ReferenceMotion:
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


def resolve(name_or_path: str) -> ReferenceMotion:
    """The motion of that name that we ship, of an .npz file (`load`), or of a public one (`load_trajectory`).

    Raises:
      ValueError: no such name or file, or a file that holds no motion of Cassie.
    """
    if name_or_path in SHIPPED:
        return load(shipped_path(name_or_path))[0]
    path = Path(name_or_path)
    if not path.is_file():
        raise ValueError(f"reference={name_or_path!r} is neither {', '.join(SHIPPED)} nor a file.")
    return load(path)[0] if path.suffix == ".npz" else load_trajectory(path)


def shipped_path(name: str) -> Path:
    """The file of a motion in `SHIPPED`."""
    return Path(str(files("cassie_mjx"))) / "motions" / f"{name}.npz"


def save(path: Path, motion: ReferenceMotion, provenance: dict[str, Any]) -> None:
    """Write `motion` and where it came from to `path`, whole or not at all."""
    content: dict[str, Any] = {name: np.asarray(getattr(motion, name), np.float64) for name in _ARRAYS}
    content |= {"format": _FORMAT, "version": _VERSION, "provenance": json.dumps(provenance)}
    partial = path.with_name(path.name + ".partial")
    with partial.open("wb") as file:
        np.savez(file, **content)
    partial.replace(path)


def load(path: Path) -> tuple[ReferenceMotion, dict[str, Any]]:
    """Read what `save` wrote: the motion, in NumPy float64, and its provenance.

    Raises:
      ValueError: the file is not readable, not of this format and version, or not a motion of Cassie.
    """
    names = ("format", "version", "provenance", *_ARRAYS)
    try:
        with np.load(path, allow_pickle=False) as content:
            found = {name: np.asarray(content[name]) for name in names if name in content}
        if len(found) < len(names) or str(found["format"]) != _FORMAT:
            raise ValueError(f"it is not a {_FORMAT}; experiments.record_reference makes one.")
        version, provenance = int(found["version"]), json.loads(str(found["provenance"]))
    except (OSError, EOFError, TypeError, ValueError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} cannot be read: {error}") from error
    if version != _VERSION:
        raise ValueError(f"{path} has version {version} of the format; this program reads version {_VERSION}.")
    motion = ReferenceMotion(*(found[name] for name in _ARRAYS))
    _check(motion, path)
    return motion, provenance


def load_trajectory(path: Path) -> ReferenceMotion:
    """Read one stride of a public Cassie trajectory: rows of 98 little-endian float64, the last repeating the first.

    The stride is resampled to the nearest whole number of samples of 32 ms, and its velocities follow the change of
    pace: the published 0.84 s, 26.25 samples, become 26 samples, 0.832 s, at velocities 0.84 / 0.832 as high.

    Raises:
      ValueError: the file is cut short, no stride, or no motion of Cassie.
    """
    content = path.read_bytes()
    row_size = 8 * _COLUMNS
    if not content or len(content) % row_size:
        raise ValueError(
            f"{path} has {len(content)} bytes, no whole number of rows of {row_size}: "
            "it is cut short or not a Cassie trajectory."
        )
    rows = np.frombuffer(content, "<f8").reshape(-1, _COLUMNS)
    time, qpos, qvel = rows[:, _TIME], rows[:, _QPOS], rows[:, _QVEL]
    _check(ReferenceMotion(qpos, qvel, qpos[-1, _X] - qpos[0, _X]), path)
    duration = time[-1] - time[0]
    if not (np.diff(time) > 0).all() or not 2 * CONTROL_PERIOD_S <= duration <= _LONGEST_STRIDE_S:
        raise ValueError(
            f"{path} is not a stride: its first column, time, must rise with each row, "
            f"by 0.064 to {_LONGEST_STRIDE_S:g} s in all."
        )
    gap = np.abs(np.delete(qpos[-1] - qpos[0], _X)).max()
    if gap > _NOT_PERIODIC_RAD:
        raise ValueError(
            f"{path} is not a stride: its last row must repeat the first besides x, and is off by {gap:.3g}."
        )

    samples = round(duration / CONTROL_PERIOD_S)
    row = np.interp(np.arange(samples) * duration / samples, time - time[0], np.arange(len(time)))
    before = row.astype(int)
    share = (row - before)[:, None]
    resampled = mix_qpos(qpos[before + 1], qpos[before], share)
    resampled[:, _X] -= qpos[0, _X]
    # q'(t) = q(t T / T'), so qdot' = qdot T / T' with T' = N 0.032 s
    pace = duration / (samples * CONTROL_PERIOD_S)
    velocity = pace * (share * qvel[before + 1] + (1 - share) * qvel[before])
    return ReferenceMotion(resampled, velocity, qpos[-1, _X] - qpos[0, _X])


def make_periodic(qpos: np.ndarray, qvel: np.ndarray, model: mujoco.MjModel) -> ReferenceMotion:
    """Make a recorded stride exactly periodic, symmetric, straight and true to the mechanism.

    It goes along x from x = 0; the drift from start to end is taken out evenly; each half is the mean of itself and the
    other's mirror image; joints keep their limits; the passive joints close the loops, in position and in velocity.

    Args:
      qpos: an even number N of samples and the start of the next stride, [N + 1, 35].
      qvel: their velocities, [N + 1, 32].
      model: Cassie's model.

    Raises:
      ValueError: the stride is too far from one to be mended.
    """
    samples = len(qpos) - 1
    if samples < 2 or samples % 2:
        raise ValueError(f"A stride of {samples} samples has no two halves; record an even number of them.")
    qpos, qvel = heading_x(qpos, qvel)
    length = qpos[-1, _X]
    progress = np.arange(samples + 1) / samples
    # On the spot, so that the halves can be compared: x - L t / T
    qpos[:, _X] -= length * progress
    drift_q, drift_v = _difference(model, qpos[0], qpos[-1]), qvel[-1] - qvel[0]
    half = samples // 2
    states = []
    for k in range(half):
        images = []
        for i in (k, k + half):
            q = _moved(model, qpos[i], -drift_q * (progress[i] - 0.5))
            v = qvel[i] - drift_v * (progress[i] - 0.5) - drift_q / (samples * CONTROL_PERIOD_S)
            images.append((q, v) if i < half else (robot.mirror_qpos(q), robot.mirror_qvel(v)))
        (q, v), (q_image, v_image) = images
        q = close_loops(model, _within_limits(model, _moved(model, q, _difference(model, q, q_image) / 2)))
        states.append((q, close_loops_velocity(model, q, (v + v_image) / 2)))
    first_q, first_v = (np.array(halves) for halves in zip(*states, strict=True))
    qpos = np.concatenate([first_q, robot.mirror_qpos(first_q)])
    qpos[:, _X] += length * progress[:-1] - qpos[0, _X]
    motion = ReferenceMotion(qpos, np.concatenate([first_v, robot.mirror_qvel(first_v)]), np.asarray(length))
    worst, sentence = _beyond_limits(model, qpos)
    if worst > 0:
        raise ValueError(f"Closing the loops of the stride breaks a limit: {sentence}.")
    return motion


def heading_x(qpos: np.ndarray, qvel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A copy of states [K, 35] and [K, 32], turned and moved so that the pelvis goes from the origin along x."""
    qpos, qvel = qpos.copy(), qvel.copy()
    position, rotation = (robot.qpos_index("pelvis")[part] for part in (slice(2), slice(3, 7)))
    qpos[:, position] -= qpos[0, position]
    yaw = np.arctan2(*qpos[-1, position][::-1])
    cos, sin = np.cos(yaw), np.sin(yaw)
    turn = np.array([[cos, -sin], [sin, cos]])
    qpos[:, position] = qpos[:, position] @ turn
    qvel[:, : len(position)] = qvel[:, : len(position)] @ turn
    back = np.array([np.cos(yaw / 2), 0.0, 0.0, -np.sin(yaw / 2)])
    for row in qpos:
        quaternion = row[rotation]
        mujoco.mju_mulQuat(quaternion, back, row[rotation])
        row[rotation] = quaternion
    return qpos, qvel


def velocity_error(motion: ReferenceMotion, model: mujoco.MjModel) -> np.ndarray:
    """Largest difference between qvel and the central difference of qpos, [32], m/s and rad/s."""
    samples = len(motion.qpos)
    before, after = (sample(motion, np.arange(samples) + k, np.zeros(samples, int))[0] for k in (-1, 1))
    # qdot_k = (q_{k+1} - q_{k-1}) / (2 dt)
    moves = np.array([_difference(model, a, b) for a, b in zip(before, after, strict=True)])
    return np.abs(motion.qvel - moves / (2 * CONTROL_PERIOD_S)).max(axis=0)


def _namespace(*arrays: Array) -> ModuleType:
    return jnp if any(isinstance(array, jax.Array) for array in arrays) else np


def _difference(model: mujoco.MjModel, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    move = np.zeros(model.nv)
    mujoco.mj_differentiatePos(model, move, 1.0, start, end)
    return move


def _moved(model: mujoco.MjModel, qpos: np.ndarray, move: np.ndarray) -> np.ndarray:
    moved = qpos.copy()
    mujoco.mj_integratePos(model, moved, move, 1.0)
    return moved


def _within_limits(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    limited = model.jnt_limited.astype(bool)
    address = model.jnt_qposadr[limited]
    clipped = qpos.copy()
    clipped[address] = qpos[address].clip(*model.jnt_range[limited].T)
    return clipped


def _beyond_limits(model: mujoco.MjModel, qpos: np.ndarray) -> tuple[float, str]:
    """By how much qpos [N, 35] exceeds a joint's limits at worst, rad, and a sentence that says where."""
    joints = np.flatnonzero(model.jnt_limited)
    values = qpos[:, model.jnt_qposadr[joints]]
    low, high = model.jnt_range[joints].T
    beyond = np.maximum(values - high, low - values)
    k, j = np.unravel_index(beyond.argmax(), beyond.shape)
    name = model.joint(joints[j]).name
    return beyond[k, j], f"row {k} has {name} at {values[k, j]:.3g} rad, limits {low[j]:.3g} to {high[j]:.3g} rad"


def _check(motion: ReferenceMotion, path: Path) -> None:
    """Raise ValueError unless the arrays can be a motion of Cassie."""
    shapes = tuple(getattr(motion, name).shape for name in _ARRAYS)
    samples = len(motion.qpos) if motion.qpos.ndim else 0
    if shapes != ((samples, robot.NQ), (samples, robot.NV), ()) or samples < 2:
        raise ValueError(
            f"{path} has qpos, qvel and stride_length of shapes {', '.join(map(str, shapes))}; "
            "a motion has [N, 35], [N, 32] and [], N at least 2."
        )
    for name in _ARRAYS:
        array = getattr(motion, name)
        if array.dtype.kind != "f" or not np.isfinite(array).all():
            raise ValueError(f"{path}: {name} has values that are not finite numbers.")
    norms = np.linalg.norm(motion.qpos[:, _QUATERNIONS], axis=-1)
    k, j = np.unravel_index(np.abs(norms - 1).argmax(), norms.shape)
    if abs(norms[k, j] - 1) > _NOT_UNIT:
        raise ValueError(
            f"{path} is no motion of Cassie: row {k} has a {_QUATERNION_NAMES[j]} quaternion of norm {norms[k, j]:.3g}."
        )
    low, high = motion.qpos[:, _Z].min(), motion.qpos[:, _Z].max()
    if low < _HEIGHTS_M[0] or high > _HEIGHTS_M[1]:
        raise ValueError(
            f"{path} is no walk of Cassie: the pelvis goes from {low:.3g} to {high:.3g} m, which is not within "
            f"{_HEIGHTS_M[0]} to {_HEIGHTS_M[1]} m."
        )
    worst, sentence = _beyond_limits(load_model(ModelConfig()), motion.qpos)
    if worst > _BEYOND_LIMIT_RAD:
        raise ValueError(f"{path} is no motion of Cassie: {sentence}.")
