"""Leg odometry: what sensors tell of the pelvis' velocity, against MuJoCo's kinematics and on a walk."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from cassie_mjx.agents.controller import Controller
from cassie_mjx.robot import cassie
from cassie_mjx.robot.leg import pelvis_velocities, soles
from cassie_mjx.robot.model import xml_path


@pytest.fixture(scope="module")
def states():
    """Any angles and velocities, [20, 35] and [20, 32]."""
    rng = np.random.default_rng(0)
    qpos = cassie.STANDING_QPOS + rng.normal(0, 0.3, (20, cassie.NQ))
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    return qpos, rng.normal(size=(20, cassie.NV))


def test_soles_and_velocities_are_those_of_mujoco(states):
    """The MJCF has its frames with five digits, hence the tolerance."""
    model = mujoco.MjModel.from_xml_path(str(xml_path("flat")))
    data, jacobian = mujoco.MjData(model), np.zeros((3, model.nv))
    (place, _), pelvis = soles(*states), pelvis_velocities(*states)
    for k, (qpos, qvel) in enumerate(zip(*states, strict=True)):
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_forward(model, data)
        for side, foot in enumerate(cassie.FOOT_BODIES):
            middle = data.xpos[foot] + data.xmat[foot].reshape(3, 3) @ cassie.SOLE_AXIS
            turn = data.xmat[cassie.PELVIS_BODY].reshape(3, 3)
            np.testing.assert_allclose(turn @ place[k, side], middle - data.xpos[cassie.PELVIS_BODY], atol=1e-6)
            mujoco.mj_jac(model, data, jacobian, None, middle, foot)
            np.testing.assert_allclose(pelvis[k, side], qvel[:3] - jacobian @ qvel, atol=5e-6)


def test_numpy_and_jax_agree(states):
    ours, theirs = pelvis_velocities(*states), pelvis_velocities(*map(jnp.asarray, states))
    np.testing.assert_allclose(ours, theirs, atol=2e-5)


def test_it_needs_neither_place_nor_velocity_of_the_pelvis(states):
    qpos, qvel = (part.copy() for part in states)
    qpos[:, :3], qvel[:, :3] = np.nan, np.nan
    np.testing.assert_array_equal(pelvis_velocities(qpos, qvel), pelvis_velocities(*states))


def test_on_a_walk_the_lower_foot_tells_the_velocity_to_a_few_centimetres_a_second():
    model = mujoco.MjModel.from_xml_path(str(xml_path("flat")))
    data, controller, errors = mujoco.MjData(model), Controller.load("1x", model), []
    data.qpos[:], data.qvel[:] = controller.initial_state(data.qpos, data.qvel)
    while data.time < 1.4:
        targets = controller.step(data.time, data.qpos, data.qvel)
        data.ctrl[:] = controller.torque(targets, data.qpos, data.qvel) / cassie.GEAR
        mujoco.mj_step(model, data)
        lower = data.xpos[cassie.FOOT_BODIES, 2].argmin()
        errors.append(pelvis_velocities(data.qpos[None], data.qvel[None])[0, lower] - data.qvel[:3])
    # Of 0.7 m/s.
    assert np.median(np.abs(errors), axis=0).max() < 0.02
    assert np.quantile(np.abs(errors), 0.9, axis=0).max() < 0.05
