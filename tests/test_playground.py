"""MuJoCo Playground's view: its registry, its wrappers, its trainer. What needs Playground is skipped without it."""

import subprocess
import sys
from functools import partial
from importlib.util import find_spec

import jax
import jax.numpy as jnp
import numpy as np
import pytest

ROBOTS = 4


@pytest.fixture
def registry(monkeypatch):
    pytest.importorskip("mujoco_playground")
    from mujoco_playground import registry  # pyright: ignore[reportMissingImports]
    from mujoco_playground._src import mjx_env  # pyright: ignore[reportMissingImports]

    import cassie_mjx.envs.playground_env  # noqa: F401

    # Playground fetches other robots from GitHub before it makes any.
    monkeypatch.setattr(mjx_env, "ensure_menagerie_exists", lambda: None)
    return registry


@pytest.fixture
def wrap(registry):
    from mujoco_playground import wrapper  # pyright: ignore[reportMissingImports]

    return partial(wrapper.wrap_for_brax_training, episode_length=5)


def load(registry, **overrides):
    return registry.load("CassieWalk", config_overrides={name.replace("__", "."): v for name, v in overrides.items()})


def test_playground_knows_it_by_name(registry):
    env = load(registry, speed="2x", sim_dt=0.002, walk__symmetric=True)
    assert (env.observation_size, env.action_size) == (80, 10)
    assert (env.dt, env.n_substeps) == (0.032, 16)
    assert float(env._walk.motion.stride_length) == pytest.approx(2 * 0.5001, abs=1e-3)
    assert env._walk.law.symmetric
    assert env._walk.physics.model.opt.timestep == 0.002
    assert env.mj_model.nu == 10
    assert "CassieWalk" in registry.locomotion.ALL_ENVS


def test_reset_is_the_tasks(registry):
    env = load(registry)
    state = env.reset(jax.random.PRNGKey(3))
    expected = env._walk.reset(jax.random.split(jax.random.PRNGKey(3))[0])
    np.testing.assert_array_equal(state.obs, expected.observation[0])
    np.testing.assert_array_equal(state.data.qpos, expected.physics.qpos[0])
    assert not state.data.xfrc_applied.any()


def test_the_shapes_stay_as_they_are(registry, wrap):
    for full_reset in (False, True):
        env = wrap(load(registry, walk__scenario__push_n=100.0), full_reset=full_reset)
        state = jax.eval_shape(env.reset, jax.random.split(jax.random.PRNGKey(0), ROBOTS))
        after = jax.eval_shape(env.step, state, jnp.zeros((ROBOTS, 10)))
        assert jax.tree.map(lambda x: x.shape, after) == jax.tree.map(lambda x: x.shape, state)
        assert after.obs.shape == (ROBOTS, 80)


def test_a_randomized_model_is_refused_rather_than_ignored(registry, wrap):
    def heavier(model):
        axes = jax.tree.map(lambda _: None, model).tree_replace({"body_mass": 0})
        return model.tree_replace({"body_mass": jnp.outer(jnp.arange(1.0, 5.0), model.body_mass)}), axes

    env = wrap(load(registry), randomization_fn=heavier)
    for _ in range(2):
        with pytest.raises(ValueError, match="a randomization_fn would change nothing; .* ranges of walk.scenario"):
            env.reset(jax.random.split(jax.random.PRNGKey(0), ROBOTS))


@pytest.mark.parametrize(
    ("overrides", "sentence"),
    [
        ({"speed": "9x"}, "speed=9x is not a speed; give a factor from 0x to 4x"),
        ({"motion": "dance"}, "'dance' is neither walk nor a file"),
        ({"sim_dt": 0.003}, "does not divide the control step"),
        ({"ctrl_dt": 0.02}, "ctrl_dt=0.02 is not Cassie's; leave it at 0.032."),
        ({"walk__reward": "sparse"}, "reward='sparse' is not known; choose one of plain, weighted"),
    ],
)
def test_bad_input_is_one_sentence(registry, overrides, sentence):
    with pytest.raises(ValueError, match=sentence):
        load(registry, **overrides)


@pytest.mark.slow
def test_its_wrappers_drive_it(registry, wrap):
    env = wrap(load(registry))
    state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), ROBOTS))
    first, keys = np.asarray(state.data.motion.time), []
    step = jax.jit(env.step)
    for _ in range(5):
        state = step(state, jnp.zeros((ROBOTS, 10)))
        keys.append(np.asarray(state.info["rng"]))
    assert state.done.all()
    np.testing.assert_array_equal(np.asarray(state.data.motion.time)[:, 0], first[:, 0])
    assert len(np.unique(np.concatenate(keys), axis=0)) == 5 * ROBOTS


@pytest.mark.slow
def test_brax_ppo_trains_on_it(registry, wrap):
    from brax.training.agents.ppo import train as ppo

    seen = []
    ppo.train(
        environment=load(registry, sim_dt=0.002),
        wrap_env_fn=wrap,
        num_timesteps=2048,
        episode_length=5,
        num_envs=32,
        batch_size=32,
        num_minibatches=4,
        unroll_length=8,
        num_updates_per_batch=2,
        num_evals=2,
        num_eval_envs=8,
        progress_fn=lambda steps, metrics: seen.append((steps, metrics)),
    )
    assert seen[-1][0] >= 2048
    assert np.isfinite(seen[-1][1]["eval/episode_reward"])


@pytest.mark.skipif(find_spec("mujoco_playground") is not None, reason="Playground is installed")
def test_without_playground_it_says_what_to_install():
    program = """
try:
    import cassie_mjx.envs.playground_env
except ImportError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "Playground's view needs the package playground; pip install 'cassie-mjx[playground]'.\n"
