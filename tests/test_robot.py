"""Names, mirror and PD law."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from cassie_mjx.robot import cassie


def test_indices_are_those_of_the_model(model):
    for i, (name, nq, nv) in enumerate(cassie.JOINTS):
        joint = model.joint(i)
        assert joint.name == name
        np.testing.assert_array_equal(cassie.qpos_index(name), joint.qposadr[0] + np.arange(nq))
        np.testing.assert_array_equal(cassie.qvel_index(name), joint.dofadr[0] + np.arange(nv))
    for name in cassie.BODIES:
        assert cassie.body_index(name)[0] == model.body(name).id


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(ValueError, match="no joint named left-ankle; it has pelvis, left-hip-roll"):
        cassie.qpos_index("left-ankle")
    with pytest.raises(ValueError, match="no body named tail"):
        cassie.body_index("tail")


def test_mirror_is_the_mirror_image(model, standing_qpos):
    """Each body of the mirrored state lies and moves where the other side's body did, reflected in y = 0."""
    rng = np.random.default_rng(0)
    qpos, qvel = standing_qpos.copy(), rng.normal(size=cassie.NV)
    mujoco.mj_integratePos(model, qpos, rng.normal(size=cassie.NV) * 0.2, 1.0)
    here, there = mujoco.MjData(model), mujoco.MjData(model)
    here.qpos[:], here.qvel[:] = qpos, qvel
    there.qpos[:], there.qvel[:] = cassie.mirror_qpos(qpos), cassie.mirror_qvel(qvel)
    mujoco.mj_forward(model, here)
    mujoco.mj_forward(model, there)
    for name in cassie.BODIES[1:]:
        other = name.replace("left", "RIGHT").replace("right", "left").replace("RIGHT", "right")
        a, b = cassie.body_index(name, other)
        np.testing.assert_allclose(there.xpos[b], here.xpos[a] * [1, -1, 1], atol=1e-6)
        velocity = np.zeros((2, 6))
        mujoco.mj_objectVelocity(model, here, mujoco.mjtObj.mjOBJ_XBODY, a, velocity[0], 0)
        mujoco.mj_objectVelocity(model, there, mujoco.mjtObj.mjOBJ_XBODY, b, velocity[1], 0)
        np.testing.assert_allclose(velocity[1], velocity[0] * [-1, 1, -1, 1, -1, 1], atol=1e-5)
    np.testing.assert_array_equal(cassie.mirror_qpos(cassie.mirror_qpos(qpos)), qpos)
    np.testing.assert_array_equal(
        cassie.mirror_active(qpos[cassie.ACTIVE_QPOS]), cassie.mirror_qpos(qpos)[cassie.ACTIVE_QPOS]
    )


def test_pd_torque_by_hand():
    target, q, qdot = np.zeros(10), np.zeros(10), np.zeros(10)
    target[:4] = [0.5, 2.0, 0.0, 1.0]
    qdot[2:5] = [1.0, 10.0, -20.0]
    # 100*0.5; 100*2 = 200 over 112.5; -8*1; 96*1 - 9.6*10; -5*-20 = 100 over 45
    expected = [50.0, 112.5, -8.0, 0.0, 45.0, 0, 0, 0, 0, 0]
    np.testing.assert_allclose(cassie.pd_torque(target, q, qdot), expected)
    np.testing.assert_allclose(cassie.pd_torque(jnp.array(target), jnp.array(q), jnp.array(qdot)), expected, rtol=1e-6)


def test_pd_torque_with_less_damping():
    target, qdot = np.full(10, 0.1), np.tile([0.0, 0.0, 0.0, 1.0, -2.0], 2)
    # 96*0.1 - 0.25*9.6*1; 50*0.1 + 0.25*5*2
    torque = cassie.pd_torque(target, np.zeros(10), qdot, kd_scale=0.25)
    np.testing.assert_allclose(torque, [10, 10, 8.8, 7.2, 7.5] * 2)


def test_torque_as_target_undoes_the_pd_law():
    rng = np.random.default_rng(2)
    torque = rng.uniform(-0.9, 0.9, 10) * cassie.TORQUE_LIMIT
    q, qdot = rng.normal(size=(2, 10))
    np.testing.assert_allclose(cassie.pd_torque(cassie.torque_as_target(torque, q, qdot), q, qdot), torque, atol=1e-10)
