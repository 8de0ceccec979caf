"""Diverging physics: what is kept shows the divergence again in plain MuJoCo."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from seeing import FULL

from cassie_mjx.envs.config import WalkConfig
from cassie_mjx.envs.walk import WalkEnv
from cassie_mjx.motion.files import load_motion
from cassie_mjx.physics.mjx import MjxPhysics
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.physics.types import Scenario
from cassie_mjx.ppo import learner, rollout
from cassie_mjx.ppo.config import PPOConfig
from cassie_mjx.robot import cassie
from cassie_mjx.robot.ground import Ground, Terrain
from cassie_mjx.robot.model import MJX_TRAINING, ModelConfig, load_mjx_model, load_model
from cassie_mjx.training import divergence

CONFIG = PPOConfig(num_robots=2, num_steps=4, minibatch_size=8, hidden_sizes=(16,))
PUSH = replace(Scenario.nominal(2), push=np.full((2, 1, 3), 50.0), push_stop=np.full((2, 1), 1000, np.int32))
# Begins and ends within the third control step, which is physics steps 32 to 47.
HILL = replace(Scenario.nominal(2), ground=Ground.of([Terrain("sine", 0.1)] * 2))
SHORT_PUSH = replace(PUSH, push_start=np.full((2, 1), 37, np.int32), push_stop=np.full((2, 1), 42, np.int32))


@pytest.fixture
def native():
    return NativePhysics(load_model(ModelConfig(physics_hz=500)))


def replayed(physics, robot_1_turns_at=0.0, scenario=PUSH):
    """The divergence of a rollout of two robots that are pushed, one of which starts with a pelvis that turns."""
    env = WalkEnv(physics, load_motion("walk"), WalkConfig(), 2)
    state = env.reset_at(np.array([3, 8]), scenario)
    qvel = np.array(state.physics.qvel)
    qvel[1, 3] += robot_1_turns_at
    state = replace(state, physics=physics.init(state.physics.qpos, qvel))
    policy = learner.init(jax.random.key(0), CONFIG, FULL.size, cassie.NU, 1).policy
    robots = rollout.begin(policy, jax.tree.map(physics_array(physics), state))
    return divergence.replay(env, CONFIG, policy, robots, jax.random.key(1))


def physics_array(physics):
    return jnp.asarray if isinstance(physics, MjxPhysics) else np.asarray


def stepped(folder):
    """As the module's docstring has it."""
    model = mujoco.MjModel.from_binary_path(str(folder / "model.mjb"))
    before = np.load(folder / "before.npz")
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = before["qpos"], before["qvel"]
    data.qacc_warmstart[:], data.ctrl[:] = before["qacc_warmstart"], before["target"]
    for step in range(before["step"], before["step"] + before["n_steps"]):
        pushed = (before["push_start"] <= step) & (step < before["push_stop"])
        data.body("cassie-pelvis").xfrc_applied[:3] = pushed @ before["push"]
        mujoco.mj_step(model, data)
    return data


def test_what_diverged_diverges_in_plain_mujoco(native, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its warnings
    found = replayed(native, robot_1_turns_at=1e9) or pytest.fail("no divergence")
    assert found["qvel"][3] > 1e8
    divergence.dump(tmp_path / "nan", native, found)
    assert not np.isfinite(stepped(tmp_path / "nan").qpos).all()


@pytest.mark.parametrize(("scene", "scenario"), [("flat", PUSH), ("flat", SHORT_PUSH), ("terrain", HILL)])
def test_the_step_is_the_engines(scene, scenario, tmp_path, monkeypatch):
    native = NativePhysics(load_model(ModelConfig(physics_hz=500, scene=scene)))
    advance, results = NativePhysics.advance, []

    def poisoned(self, *args):
        results.append(advance(self, *args))
        # The third step is lost.
        return replace(results[-1], qpos=np.full((2, cassie.NQ), np.nan)) if len(results) == 3 else results[-1]

    monkeypatch.setattr(NativePhysics, "advance", poisoned)
    found = replayed(native, scenario=scenario) or pytest.fail("no divergence")
    divergence.dump(tmp_path / "nan", native, found)
    data = stepped(tmp_path / "nan")
    np.testing.assert_allclose(data.qpos, results[2].qpos[0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(data.qvel, results[2].qvel[0], rtol=0, atol=1e-9)


def test_without_a_divergence_there_is_nothing_to_keep(native):
    assert replayed(native) is None


@pytest.mark.slow
def test_on_mjx_the_same(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    physics = MjxPhysics(load_mjx_model(replace(MJX_TRAINING, physics_hz=500)))
    found = replayed(physics, robot_1_turns_at=1e9) or pytest.fail("no divergence")
    divergence.dump(tmp_path / "nan", physics, found)
    assert not np.isfinite(stepped(tmp_path / "nan").qpos).all()


def test_terrain_on_mjx_is_kept_as_a_height_field(native, tmp_path):
    found = {
        "qpos": native.model.qpos0,
        **{f"ground_{name}": value for name, value in vars(Terrain("sine", 0.1).ground).items()},
        "kd_scale": np.float32(1),
    }
    divergence.dump(tmp_path / "nan", native, found)
    model = mujoco.MjModel.from_binary_path(str(tmp_path / "nan" / "model.mjb"))
    assert (model.nhfield, model.opt.timestep) == (1, 0.002)
    assert np.ptp(model.hfield_data * model.hfield_size[0, 2]) == pytest.approx(0.2, rel=0.01)
