"""From a recorded stride to a reference motion: periodic, symmetric, straight, true to the mechanism."""

import mujoco
import numpy as np

from cassie_mjx.motion.reference import ReferenceMotion, sample
from cassie_mjx.robot import cassie
from cassie_mjx.robot.cassie import CONTROL_PERIOD_S
from cassie_mjx.robot.loops import close_loops, close_loops_velocity


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
    length = qpos[-1, cassie.PELVIS_X]
    progress = np.arange(samples + 1) / samples
    # On the spot, so that the halves can be compared: x - L t / T
    qpos[:, cassie.PELVIS_X] -= length * progress
    drift_q, drift_v = _difference(model, qpos[0], qpos[-1]), qvel[-1] - qvel[0]
    half = samples // 2
    states = []
    for k in range(half):
        images = []
        for i in (k, k + half):
            q = _moved(model, qpos[i], -drift_q * (progress[i] - 0.5))
            v = qvel[i] - drift_v * (progress[i] - 0.5) - drift_q / (samples * CONTROL_PERIOD_S)
            images.append((q, v) if i < half else (cassie.mirror_qpos(q), cassie.mirror_qvel(v)))
        (q, v), (q_image, v_image) = images
        q = close_loops(model, _within_limits(model, _moved(model, q, _difference(model, q, q_image) / 2)))
        states.append((q, close_loops_velocity(model, q, (v + v_image) / 2)))
    first_q, first_v = (np.array(halves) for halves in zip(*states, strict=True))
    qpos = np.concatenate([first_q, cassie.mirror_qpos(first_q)])
    qpos[:, cassie.PELVIS_X] += length * progress[:-1] - qpos[0, cassie.PELVIS_X]
    motion = ReferenceMotion(qpos, np.concatenate([first_v, cassie.mirror_qvel(first_v)]), np.asarray(length))
    worst, sentence = beyond_limits(model, qpos)
    if worst > 0:
        raise ValueError(f"Closing the loops of the stride breaks a limit: {sentence}.")
    return motion


def heading_x(qpos: np.ndarray, qvel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A copy of states [K, 35] and [K, 32], turned and moved so that the pelvis goes from the origin along x."""
    qpos, qvel = qpos.copy(), qvel.copy()
    position, rotation = (cassie.qpos_index("pelvis")[part] for part in (slice(2), slice(3, 7)))
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
    before, after = (sample(motion, np.arange(samples) + k)[0] for k in (-1, 1))
    # qdot_k = (q_{k+1} - q_{k-1}) / (2 dt)
    moves = np.array([_difference(model, a, b) for a, b in zip(before, after, strict=True)])
    return np.abs(motion.qvel - moves / (2 * CONTROL_PERIOD_S)).max(axis=0)


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


def beyond_limits(model: mujoco.MjModel, qpos: np.ndarray) -> tuple[float, str]:
    """By how much qpos [N, 35] exceeds a joint's limits at worst, rad, and a sentence that says where."""
    joints = np.flatnonzero(model.jnt_limited)
    values = qpos[:, model.jnt_qposadr[joints]]
    low, high = model.jnt_range[joints].T
    beyond = np.maximum(values - high, low - values)
    k, j = np.unravel_index(beyond.argmax(), beyond.shape)
    name = model.joint(joints[j]).name
    return beyond[k, j], f"row {k} has {name} at {values[k, j]:.3g} rad, limits {low[j]:.3g} to {high[j]:.3g} rad"
