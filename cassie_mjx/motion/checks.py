"""Whether arrays are a motion of Cassie: checked against the robot and against each other, with the likely cause."""

import warnings
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from cassie_mjx.motion.causes import CAUSES
from cassie_mjx.motion.recording import beyond_limits
from cassie_mjx.motion.reference import QUATERNION_NAMES, QUATERNIONS, ReferenceMotion, sample
from cassie_mjx.robot import cassie
from cassie_mjx.robot.cassie import CONTROL_PERIOD_S
from cassie_mjx.robot.loops import loop_error
from cassie_mjx.robot.model import ModelConfig, load_model
from cassie_mjx.robot.rotation import yaw

ARRAYS = ("qpos", "qvel", "stride_length")

# Parts of qvel that are checked one by one: their unit, and the speed below which they are at rest.
_VELOCITIES = (
    ("pelvis velocities", cassie.PELVIS_VELOCITY, 0.05),
    ("pelvis angular velocities", cassie.PELVIS_ANGULAR_VELOCITY, 0.1),
    ("joint velocities", np.arange(cassie.NV)[6:], 0.1),
)


class _Finding(NamedTuple):
    """What one check has measured."""

    error: float
    unusual: float
    """Largest error that passes in silence."""
    refused: float
    """Largest error that passes with a warning."""
    sentence: str

    @property
    def refuses(self) -> bool:
        return not self.error <= self.refused


def check_arrays(motion: ReferenceMotion, path: Path) -> None:
    """Raise ValueError unless the arrays have a motion's shapes, finite numbers, and configurations of Cassie."""
    shapes = tuple(getattr(motion, name).shape for name in ARRAYS)
    samples = len(motion.qpos) if motion.qpos.ndim else 0
    if shapes != ((samples, cassie.NQ), (samples, cassie.NV), ()) or samples < 2:
        raise ValueError(
            f"{path} has qpos, qvel and stride_length of shapes {', '.join(map(str, shapes))}; "
            "a motion has [N, 35], [N, 32] and [], N at least 2."
        )
    for name in ARRAYS:
        array = getattr(motion, name)
        if array.dtype.kind != "f" or not np.isfinite(array).all():
            raise ValueError(f"{path}: {name} has values that are not finite numbers.")
    _run(_CONFIGURATION, motion, path)


def check_motion(motion: ReferenceMotion, path: Path) -> None:
    """Hold a motion that has passed `check_arrays` against the robot and itself; warn of what is only unusual.

    Raises:
      ValueError: the legs' loops are open, the pelvis faces backward, the feet float or sink, qvel is not the change of
        qpos, or a stride does not repeat.
    """
    for finding in _run((*_CONFIGURATION, *_MOVEMENT), motion, path):
        if finding.error > finding.unusual:
            warnings.warn(f"{path} is an unusual motion: {finding.sentence}.", stacklevel=3)


_Check = Callable[[ReferenceMotion, mujoco.MjModel], _Finding]


def _run(checks: Sequence[_Check], motion: ReferenceMotion, path: Path) -> list[_Finding]:
    """What the checks find. Raise ValueError at the first that refuses, with the likely cause."""
    findings = []
    for number, check in enumerate(checks, 1):
        findings.append(finding := check(motion, _model()))
        if finding.refuses:
            cause = _cause(motion, checks, number)
            raise ValueError(f"{path} is no motion of Cassie: {finding.sentence}{cause and f'; {cause}'}.")
    return findings


def _cause(motion: ReferenceMotion, checks: Sequence[_Check], number: int) -> str:
    """The cause without which a motion would pass all checks, or else the first `number`; "" if there is none."""
    for wanted in (checks, checks[:number]):
        for cause, undo in CAUSES:
            meant = undo(motion)
            if not any(check(meant, _model()).refuses for check in wanted):
                return cause
    return ""


@cache
def _model() -> mujoco.MjModel:
    return load_model(ModelConfig())


def _norms(motion: ReferenceMotion, model: mujoco.MjModel) -> _Finding:
    norms = np.linalg.norm(motion.qpos[:, QUATERNIONS], axis=-1)
    k, j = np.unravel_index(np.abs(norms - 1).argmax(), norms.shape)
    sentence = f"row {k} has a {QUATERNION_NAMES[j]} quaternion of norm {norms[k, j]:.3g}"
    return _Finding(abs(norms[k, j] - 1), 1e-3, 1e-3, sentence)


def _heights(motion: ReferenceMotion, model: mujoco.MjModel) -> _Finding:
    low, high = motion.qpos[:, cassie.PELVIS_Z].min(), motion.qpos[:, cassie.PELVIS_Z].max()
    limits = cassie.FALL_LOW_M, cassie.FALL_HIGH_M
    sentence = f"the pelvis goes from {low:.3g} to {high:.3g} m, which is not within {limits[0]} to {limits[1]} m"
    return _Finding(max(limits[0] - low, high - limits[1]), 0.0, 0.0, sentence)


def _limits(motion: ReferenceMotion, model: mujoco.MjModel) -> _Finding:
    # Coarse: recorded motions overshoot the limits a little.
    worst, sentence = beyond_limits(model, motion.qpos)
    return _Finding(worst, 0.3, 0.3, sentence)


def _loops(motion: ReferenceMotion, model: mujoco.MjModel) -> _Finding:
    # Public strides open them by up to 7 mm.
    errors = loop_error(model, motion.qpos)
    return _Finding(
        errors.max(), 0.01, 0.03, f"row {errors.argmax()} opens the loops of the legs by {errors.max():.3g} m"
    )


def _facing(motion: ReferenceMotion, model: mujoco.MjModel) -> _Finding:
    facing = float(yaw(motion.qpos[0, cassie.PELVIS_QUATERNION]))
    sentence = f"the pelvis faces {np.rad2deg(facing):.0f} degrees away from the x axis in its first row"
    return _Finding(abs(facing), 0.5, np.pi / 2, sentence)


def _ground(motion: ReferenceMotion, model: mujoco.MjModel) -> _Finding:
    lowest = foot_heights(model, motion.qpos).min(axis=1)
    above, below = lowest.min(), -np.median(lowest)
    where = f"above the floor all the time, by {above:.3g} m or more"
    if below > above:
        where = f"below the floor half the time, by {below:.3g} m or more"
    return _Finding(max(above, below), 0.05, 0.1, f"its lower foot is {where}")


def _velocity(name: str, part: np.ndarray, rest: float) -> _Check:
    """The check of one part of qvel against the change of qpos: their direction first, then their size."""

    def check(motion: ReferenceMotion, model: mujoco.MjModel) -> _Finding:
        change = differences(model, motion.qpos)[:, part]
        # (q_{k+1} - q_k) / dt = (v_k + v_{k+1}) / 2
        mean = (motion.qvel[1:] + motion.qvel[:-1])[:, part] / 2
        size, wanted = np.linalg.norm(mean), np.linalg.norm(change)
        if max(size, wanted) <= rest * np.sqrt(mean.size):
            return _Finding(0.0, 0.0, 0.0, "")
        product = (mean * change).sum()
        cosine = product / max(size * wanted, 1e-12)
        if abs(cosine) < 0.5:
            return _Finding(1 - cosine, 0.0, 0.0, f"its {name} do not follow the change of qpos")
        factor = size**2 / product
        sentence = f"its {name} are {factor:.3g} times the change of qpos in 0.032 s, {_why(factor, name)}"
        return _Finding(np.inf if factor < 0 else abs(np.log2(factor)), 0.5, 1.0, sentence)

    return check


def _why(factor: float, name: str) -> str:
    """Why velocities may be `factor` times what they should be."""
    if factor < 0:
        return "as if reversed in time"
    if 0.9 < factor / np.rad2deg(1) < 1.1 and name != _VELOCITIES[0][0]:
        return "as degrees a second would be; they are to be rad/s"
    if 0.9 < factor / CONTROL_PERIOD_S < 1.1:
        return "as changes per sample would be; they are to be per second"
    size = f"{factor:.3g} times too large" if factor > 1 else f"{1 / factor:.3g} times too small"
    return f"so they look {size}, or the samples {CONTROL_PERIOD_S / factor:.2g} s apart instead of 0.032 s"


def _stride_length(motion: ReferenceMotion, model: mujoco.MjModel) -> _Finding:
    x, velocity = motion.qpos[:, cassie.PELVIS_X], motion.qvel[:, cassie.PELVIS_VELOCITY[0]]
    wanted = x[-1] - x[0]
    if motion.periodic:
        wanted += CONTROL_PERIOD_S * (velocity[0] + velocity[-1]) / 2
    sentence = f"its stride_length is {motion.stride_length:.3f} m, and its pelvis goes {wanted:.3f} m along x"
    return _Finding(abs(float(motion.stride_length) - wanted), 0.03, 0.1, sentence)


def _repeats(motion: ReferenceMotion, model: mujoco.MjModel) -> _Finding:
    if not motion.periodic:
        return _Finding(0.0, 0.0, 0.0, "")
    seam = sample(motion, np.array([-1, 0]))
    expected = seam[1].mean(axis=0)
    gap = CONTROL_PERIOD_S * np.abs(differences(model, seam[0])[0] - expected)
    sentence = f"its last row does not lead to its first, by {gap.max():.3g} m or rad, as periodic=True wants"
    return _Finding(gap.max(), 0.15, 0.3, sentence)


def _path(motion: ReferenceMotion, model: mujoco.MjModel) -> _Finding:
    way = (motion.qpos[-1] - motion.qpos[0])[[cassie.PELVIS_X, cassie.PELVIS_Y]]
    angle = abs(np.arctan2(way[1], way[0])) if np.linalg.norm(way) > 0.1 else 0.0
    sentence = f"it goes {way[0]:.3g} m along x and {way[1]:.3g} m along y, and references go along x"
    return _Finding(angle, 0.5, np.inf, sentence)


def foot_heights(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Heights of the lowest points of left toe, left heel, right toe, right heel at qpos [N, 35], [N, 4], m."""
    data, heights = mujoco.MjData(model), []
    for configuration in qpos:
        data.qpos[:] = configuration
        mujoco.mj_kinematics(model, data)
        feet = data.xpos[cassie.FOOT_BODIES], data.xmat[cassie.FOOT_BODIES].reshape(2, 3, 3)
        ends = feet[0][:, None] + np.einsum("fij,ej->fei", feet[1], [cassie.TOE, cassie.HEEL])
        heights.append(ends[..., 2].ravel() - cassie.FOOT_RADIUS_M)
    return np.array(heights)


def differences(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Mean velocities from each of qpos [N, 35], 0.032 s apart, to the next, [N - 1, 32]."""
    moves = np.zeros((len(qpos) - 1, model.nv))
    for move, start, end in zip(moves, qpos[:-1], qpos[1:], strict=True):
        mujoco.mj_differentiatePos(model, move, CONTROL_PERIOD_S, start, end)
    return moves


_CONFIGURATION: tuple[_Check, ...] = (_norms, _heights, _limits)
_MOVEMENT = (_loops, _facing, _ground, *(_velocity(*each) for each in _VELOCITIES), _stride_length, _repeats, _path)
