"""MuJoCo Warp, which mujoco-mjx can drive, against MuJoCo C on our robot: loops that move, and feet on the floor.

On its CPU device, which is slow; it needs the extra `warp`.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from cassie_mjx.robot.model import ModelConfig, load_model, servo_model
from experiments.agreement import AgreementConfig, draw

pytest.importorskip("warp")


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0.0, 1.0, 3.0])
def test_warp_accelerates_as_mujoco_c_does(speed):
    """With the bias J̇v of the loops, which moving robots need; in float32, so relative to the largest."""
    model = servo_model(load_model(ModelConfig(physics_hz=1000)))
    # MuJoCo Warp has no reset that could be left out.
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    qpos, qvel, targets = draw(AgreementConfig(robots=2), model, speed)
    warp = mjx.put_model(model, impl="warp")
    start = mjx.make_data(model, impl="warp", naconmax=64, njmax=160)
    forward, data = jax.jit(mjx.forward), mujoco.MjData(model)
    for q, v, target in zip(qpos, qvel, targets, strict=True):
        state = {"qpos": q, "qvel": v, "ctrl": target}
        found = forward(warp, start.replace(**{name: jnp.asarray(x, jnp.float32) for name, x in state.items()}))
        data.qpos[:], data.qvel[:], data.ctrl[:], data.qacc_warmstart[:] = q, v, target, 0
        mujoco.mj_forward(model, data)
        assert data.ncon > 0
        np.testing.assert_allclose(found.qacc, data.qacc, atol=2e-3 * np.abs(data.qacc).max())
