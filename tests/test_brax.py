"""Brax's wrappers and its PPO on `CassieEnv`, and what Brax could ask for in vain."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax import envs
from brax.envs.wrappers import training as wrappers
from brax.training.agents.ppo import train as ppo

from cassie_mjx.envs.brax_env import CassieEnv
from cassie_mjx.envs.config import WalkConfig
from cassie_mjx.envs.scenario import ScenarioConfig
from cassie_mjx.motion.files import load_motion

ROBOTS = 4


@pytest.fixture(scope="module")
def motion():
    return load_motion("walk")


def test_brax_wrappers_drive_it(motion):
    env = wrappers.wrap(CassieEnv(motion), episode_length=5)
    state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), ROBOTS))
    assert state.obs.shape == (ROBOTS, 80)
    assert env.unwrapped.dt == pytest.approx(0.032)
    first = np.asarray(state.pipeline_state.motion.time)
    step = jax.jit(env.step)
    for _ in range(5):
        state = step(state, jnp.zeros((ROBOTS, 10)))
    assert state.done.all()
    np.testing.assert_array_equal(np.asarray(state.pipeline_state.motion.time)[:, 0], first[:, 0])


def test_brax_knows_it_by_name():
    env = envs.create("cassie_walk", episode_length=5, batch_size=ROBOTS, speed="2x", physics_hz=500)
    state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
    assert (state.obs.shape, env.action_size) == ((ROBOTS, 80), 10)
    assert float(env.unwrapped._walk.motion.stride_length) == pytest.approx(2 * 0.5001, abs=1e-3)
    assert env.unwrapped._walk.physics.model.opt.timestep == 0.002


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"speed": "any"}, "speed=any is not a speed; give a factor from 0x to 4x"),
        ({"config": "rough"}, "config='rough' is not known; choose one of undisturbed, robust"),
        ({"config": "robust"}, "are not for CassieEnv"),
        ({"physics_hz": 700}, "physics_hz=700 does not divide"),
    ],
)
def test_bad_input_by_name_is_one_sentence(given, sentence):
    with pytest.raises(ValueError, match=sentence):
        envs.get_environment("cassie_walk", **given)


@pytest.mark.slow
def test_brax_ppo_trains_on_it(motion):
    seen = []
    train = partial(ppo.train, num_timesteps=4096, episode_length=50, num_envs=32, batch_size=32, num_minibatches=4)
    train = partial(train, unroll_length=8, num_updates_per_batch=2, normalize_observations=True, num_evals=2, seed=0)
    train(
        environment=CassieEnv(motion), num_eval_envs=8, progress_fn=lambda steps, metrics: seen.append((steps, metrics))
    )
    assert seen[-1][0] >= 4096
    assert np.isfinite(seen[-1][1]["eval/episode_reward"])


def test_brax_gets_no_disturbances(motion):
    with pytest.raises(ValueError, match="are not for CassieEnv"):
        CassieEnv(motion, WalkConfig(scenario=ScenarioConfig(push_n=100)))


def test_a_randomized_system_is_refused_rather_than_ignored(motion):
    def heavier(system):
        axes = jax.tree.map(lambda _: None, system).tree_replace({"body_mass": 0})
        return system.tree_replace({"body_mass": jnp.outer(jnp.arange(1.0, 5.0), system.body_mass)}), axes

    env = CassieEnv(motion)
    wrapped = wrappers.wrap(env, randomization_fn=heavier)
    for _ in range(2):
        with pytest.raises(ValueError, match="a randomization_fn would change nothing; .* the ranges of walk.scenario"):
            wrapped.reset(jax.random.split(jax.random.PRNGKey(0), ROBOTS))
    assert env.sys.nv == 32
