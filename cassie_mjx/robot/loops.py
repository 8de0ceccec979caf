"""The closed loops of the legs: how far open they are, and what closes them."""

import mujoco
import numpy as np

from cassie_mjx.robot import cassie


def close_loops(model: mujoco.MjModel, qpos: np.ndarray, tolerance_m: float = 1e-10) -> np.ndarray:
    """Move the passive joints of `qpos` [35] until the four loops close; pelvis, active joints and springs stay.

    Raises:
      ValueError: no nearby configuration closes the loops.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    residual = np.full(1, np.inf)
    for _ in range(50):
        mujoco.mj_fwdPosition(model, data)
        residual = data.efc_pos[: data.ne].copy()
        if np.abs(residual).max() < tolerance_m:
            return data.qpos.copy()
        jacobian = data.efc_J.reshape(-1, model.nv)[: data.ne, cassie.LOOP_QVEL]
        move = np.zeros(model.nv)
        move[cassie.LOOP_QVEL] = -np.linalg.lstsq(jacobian, residual, rcond=1e-9)[0]
        mujoco.mj_integratePos(model, data.qpos, move, 1.0)
    raise ValueError(
        f"The loops stay open by {np.abs(residual).max():.2g} m: these joint angles do not fit the mechanism."
    )


def close_loops_velocity(model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """Change the passive joints' velocities in qvel [32] as little as keeps the loops closed at qpos [35]."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_fwdPosition(model, data)
    jacobian = data.efc_J.reshape(-1, model.nv)[: data.ne]
    fitted = qvel.copy()
    # J qvel = 0
    fitted[cassie.LOOP_QVEL] -= np.linalg.lstsq(jacobian[:, cassie.LOOP_QVEL], jacobian @ qvel, rcond=1e-9)[0]
    return fitted


def loop_error(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Largest distance between the two anchors of a loop, m, for each of qpos [..., 35]."""
    data = mujoco.MjData(model)
    flat = np.asarray(qpos, float).reshape(-1, model.nq)
    errors = np.empty(len(flat))
    for i, configuration in enumerate(flat):
        data.qpos[:] = configuration
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        anchors = [
            data.xpos[body] + data.xmat[body].reshape(3, 3) @ anchor
            for bodies, eq in zip(zip(model.eq_obj1id, model.eq_obj2id, strict=True), model.eq_data, strict=True)
            for body, anchor in zip(bodies, (eq[:3], eq[3:6]), strict=True)
        ]
        errors[i] = np.linalg.norm(np.subtract(anchors[::2], anchors[1::2]), axis=1).max()
    return errors.reshape(np.shape(qpos)[:-1])
