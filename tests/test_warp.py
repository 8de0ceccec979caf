"""MuJoCo Warp, which mujoco-mjx can drive, against MuJoCo C on our robot: loops that move, and feet on the floor.

On its CPU device, which is slow; it needs the extra `warp`.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from cassie_mjx.robot import cassie
from cassie_mjx.robot.model import ModelConfig, load_model, servo_model
from experiments.agreement import AgreementConfig, draw

pytest.importorskip("warp")


@pytest.fixture(scope="module")
def compared():
    """MuJoCo C's model and data; Warp's model, empty data, and its compiled `mjx.forward` and `mjx.step`."""
    model = servo_model(load_model(ModelConfig(physics_hz=1000)))
    # MuJoCo Warp has no reset that could be left out.
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    empty = mjx.make_data(model, impl="warp", naconmax=256, njmax=160)
    return (
        model,
        mujoco.MjData(model),
        mjx.put_model(model, impl="warp"),
        empty,
        jax.jit(mjx.forward),
        jax.jit(mjx.step),
    )


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0.0, 1.0, 3.0])
def test_warp_moves_as_mujoco_c_does(compared, speed):
    """With the bias J̇v of the loops, which moving robots need; in float32, for 32 steps of 1 ms."""
    model, data, warp, empty, forward, step = compared
    qpos, qvel, targets = (each[0] for each in draw(AgreementConfig(robots=1), model, speed))
    mujoco.mj_resetData(model, data)
    data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, targets
    start = {"qpos": qpos, "qvel": qvel, "ctrl": targets}
    ours = empty.replace(**{name: jnp.asarray(x, jnp.float32) for name, x in start.items()})
    found = forward(warp, ours)
    mujoco.mj_forward(model, data)
    assert data.ncon > 0
    np.testing.assert_allclose(found.qacc, data.qacc, atol=1e-2 * np.abs(data.qacc).max())
    data.qacc_warmstart[:] = 0
    for _ in range(32):
        ours = step(warp, ours)
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(ours.qpos[:3], data.qpos[:3], atol=2e-6)
    np.testing.assert_allclose(ours.qpos[cassie.ACTIVE_QPOS], data.qpos[cassie.ACTIVE_QPOS], atol=5e-5)
