"""The heuristic controller on MJX: the same law in float32, compiled with the physics into one loop."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from cassie_mjx.heuristic import law
from cassie_mjx.heuristic.config import CONTROLLERS
from cassie_mjx.heuristic.pendulum import Masses
from cassie_mjx.physics.mjx import MjxPhysics
from cassie_mjx.physics.types import Scenario
from cassie_mjx.robot import cassie
from cassie_mjx.robot.model import MJX_TRAINING, load_mjx_model

SECONDS, ROBOTS = 10.0, 2


@pytest.mark.slow
@pytest.mark.parametrize("name", CONTROLLERS)
def test_walks_ten_seconds(standing_qpos, name):
    config = CONTROLLERS[name]
    physics = MjxPhysics(load_mjx_model(replace(MJX_TRAINING, contacts="full")))
    act_steps = round(config.period * 1000)
    scenario = Scenario.nominal(ROBOTS)
    qvel = 0.02 * np.random.default_rng(0).normal(size=(ROBOTS, cassie.NV)).astype(np.float32)
    state = physics.init(np.tile(standing_qpos, (ROBOTS, 1)).astype(np.float32), qvel)
    masses = Masses.of(physics.model)
    control = law.init(config, state.qpos, physics.bodies(state))

    def act(carry, _):
        state, control = carry
        target, control = law.step(
            config, masses, control, state.qpos, state.qvel, physics.bodies(state), config.period
        )
        state = physics.advance(state, target, scenario, act_steps)
        return (state, control), state.qpos[:, :3]

    acts = round(SECONDS / config.period)
    (state, _), pelvis = jax.jit(lambda s, c: jax.lax.scan(act, (s, c), None, length=acts))(state, control)
    height = np.asarray(pelvis[..., 2])
    assert height.min() > cassie.FALL_LOW_M
    assert height.max() < cassie.FALL_HIGH_M
    late = np.asarray(pelvis)[-round(4.928 / config.period) :, :, 0]
    np.testing.assert_allclose((late[-1] - late[0]) / 4.928, 0.7, atol=0.1)
