"""The learner's update: direction, step sizes, every option's effect, reproducibility, and several devices."""

import os
import subprocess
import sys
from dataclasses import replace

import acting
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cassie_mjx.ppo import learner, networks
from cassie_mjx.ppo.config import PPOConfig
from cassie_mjx.ppo.types import Rollout

CONFIG = PPOConfig(num_robots=8, num_steps=8, updates_per_iteration=6, minibatch_size=32, hidden_sizes=(16,))


@pytest.fixture(scope="module", autouse=True)
def quick_compilation():
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


def make_rollout(config: PPOConfig, state: learner.LearnerState, seed: int = 0) -> Rollout:
    """Noise in place of an environment: 5 inputs, 3 actions, one end in ten of either kind."""
    rng, shape = np.random.default_rng(seed), (config.num_steps, config.num_robots)
    observation = jnp.asarray(rng.normal(size=(*shape, 5)), jnp.float32)
    hidden = jnp.zeros((*shape, 0))
    action, log_prob, _ = networks.sample(state.policy, observation, hidden, jax.random.key(seed))
    return Rollout(
        observation=observation,
        action=action,
        log_prob=log_prob,
        reward=jnp.asarray(rng.random(shape), jnp.float32),
        terminated=jnp.asarray(rng.random(shape) < 0.1),
        truncated=jnp.asarray(rng.random(shape) < 0.1),
        final_observation=jnp.asarray(rng.normal(size=(*shape, 5)), jnp.float32),
        privileged=jnp.asarray(rng.normal(size=(*shape, 2)), jnp.float32),
        final_privileged=jnp.asarray(rng.normal(size=(*shape, 2)), jnp.float32),
        hidden=hidden,
        metrics={},
    )


def updated(config: PPOConfig) -> tuple[learner.LearnerState, learner.LearnerState, learner.UpdateMetrics]:
    before = learner.init(jax.random.key(0), config, 5, 3, 2)
    after, metrics = learner.update(config, before, make_rollout(config, before), jax.random.key(1))
    return before, after, metrics


@pytest.mark.parametrize("best", [0.5, -0.5])
def test_bandit_moves_towards_the_better_arm(best):
    config = replace(CONFIG, num_robots=256, num_steps=1, minibatch_size=256, target_kl=None, actor_learning_rate=3e-3)
    state = learner.init(jax.random.key(0), config, 5, 3, 2)
    for iteration in range(10):
        pulls = make_rollout(config, state, seed=iteration)
        reward = -jnp.square(pulls.action - best).sum(axis=-1)
        pulls = pulls._replace(reward=reward, terminated=jnp.ones_like(pulls.terminated))
        state, _ = learner.update(config, state, pulls, jax.random.key(iteration))
    observation = jnp.asarray(np.random.default_rng(0).normal(size=(256, 5)), jnp.float32)
    mean = acting.mode(state.policy, observation).mean(axis=0)
    assert (np.sign(best) * mean > 0.1).all()


@pytest.mark.parametrize("privileged", [True, False])
def test_a_critic_learns_what_only_it_can_see_if_it_may(privileged):
    config = replace(CONFIG, privileged_critic=privileged, critic_learning_rate=1e-2, updates_per_iteration=200)
    state = learner.init(jax.random.key(0), config, 5, 3, 2)
    lived = make_rollout(config, state)
    ended = jnp.ones_like(lived.terminated)
    lived = lived._replace(observation=jnp.zeros_like(lived.observation), terminated=ended, truncated=~ended)
    lived = lived._replace(reward=lived.privileged[..., 0])
    learned, _ = learner.update(config, state, lived, jax.random.key(1))
    _, metrics = learner.update(config, learned, lived, jax.random.key(2))
    assert (metrics.explained_variance > 0.9) == privileged


def test_at_a_time_limit_the_critic_values_what_it_saw_before_the_reset():
    """A critic that is the sum of its privileged inputs, one step: target = reward + gamma x final_privileged."""
    config = replace(CONFIG, hidden_sizes=(2,), gae_lambda=0.0, gamma=0.5, updates_per_iteration=1)
    state = learner.init(jax.random.key(0), config, 5, 3, 2)
    lived = make_rollout(config, state)
    cut = jnp.ones_like(lived.truncated)
    lived = lived._replace(truncated=cut, terminated=~cut, final_privileged=abs(lived.final_privileged))
    passing = {"kernel": jnp.zeros((7, 2)).at[5, 0].set(1).at[6, 1].set(1), "bias": jnp.zeros(2)}
    summing = {"kernel": jnp.ones((2, 1)), "bias": jnp.zeros(1)}
    batch, _ = learner._prepare(config, state._replace(critic={"hidden_0": passing, "output": summing}), lived, None)
    expected = lived.reward + 0.5 * lived.final_privileged.sum(axis=-1)
    np.testing.assert_allclose(batch.value_target, expected.ravel(), rtol=1e-5)


def test_adams_first_step_is_as_long_as_the_learning_rate():
    before, after, metrics = updated(replace(CONFIG, updates_per_iteration=1, max_grad_norm=None, adam_epsilon=1e-12))
    actor, critic = (
        jax.tree.map(lambda new, old: abs(new - old).max(), getattr(after, name), getattr(before, name))
        for name in ("policy", "critic")
    )
    np.testing.assert_allclose(actor.actor["output"]["kernel"], 3e-4, rtol=1e-2)
    np.testing.assert_allclose(critic["output"]["kernel"], 1e-3, rtol=1e-2)
    np.testing.assert_allclose((metrics.actor_learning_rate, metrics.critic_learning_rate), (3e-4, 1e-3), rtol=1e-6)


def test_update_leaves_the_normalizer_alone_and_counts_itself():
    before, after, _ = updated(CONFIG)
    jax.tree.map(np.testing.assert_array_equal, before.policy.normalizer, after.policy.normalizer)
    assert (before.iteration, after.iteration) == (0, 1)


def test_same_key_same_bits():
    jax.tree.map(np.testing.assert_array_equal, updated(CONFIG), updated(CONFIG))


@pytest.mark.parametrize(
    ("schedule", "iteration", "factor"),
    [
        ("constant", 150, 1.0),
        ("linear", 50, 0.75),
        ("linear", 195, 0.1),  # 1 - 195/200 is below the floor
        ("cosine", 66, 1.0),
        ("cosine", 400 / 3, 0.5),
        ("cosine", 195, 0.1),
        ("exponential", 2, 0.9801),
        ("exponential", 300, 0.1),  # 0.99^300 = 0.049 is below the floor
    ],
)
def test_schedules(schedule, iteration, factor):
    config = replace(CONFIG, iterations=200, actor_schedule=schedule, critic_schedule=schedule, learning_rate_floor=0.1)
    state = learner.init(jax.random.key(0), config, 5, 3, 2)
    state = state._replace(iteration=jnp.asarray(iteration), step_factor=jnp.asarray(0.5))
    np.testing.assert_allclose(learner.learning_rates(config, state), (3e-4 * factor * 0.5, 1e-3 * factor), rtol=1e-5)


def test_noise_goes_from_its_first_width_to_its_last():
    config = replace(CONFIG, iterations=2, action_std=0.2, final_action_std=0.1)
    state, widths = learner.init(jax.random.key(0), config, 5, 3, 2), []
    for seed in range(3):
        lived = make_rollout(config, state, seed)
        widths.append(float(jnp.std(lived.action - acting.mode(state.policy, lived.observation))))
        state, _ = learner.update(config, state, lived, jax.random.key(seed))
    np.testing.assert_allclose([*widths, state.policy.std], [0.2, 0.15, 0.1, 0.1], rtol=0.15)


def test_actor_step_size_follows_the_kl_divergence():
    _, _, metrics = updated(CONFIG)
    for target, expected in ((metrics.kl / 2, 1 / 1.3), (metrics.kl, 1.0), (metrics.kl * 2, 1.3), (None, 1.0)):
        _, after, _ = updated(replace(CONFIG, target_kl=None if target is None else float(target)))
        np.testing.assert_allclose(after.step_factor, expected, rtol=1e-6)


@pytest.mark.parametrize(
    "change",
    [
        {"updates_per_iteration": 5},
        {"minibatch_size": 16},
        {"hidden_sizes": (16, 16)},
        {"privileged_critic": False},
        {"actor_output_scale": 1.0},
        {"action_std": 0.2},
        {"gamma": 0.9},
        {"gae_lambda": 0.5},
        {"clip_epsilon": 0.001},
        {"normalize_advantage": False},
        {"max_grad_norm": 1e-3},
        {"adam_epsilon": 1e-3},
    ],
    ids=lambda change: next(iter(change)),
)
def test_option_changes_what_is_learned(change):
    _, default, _ = updated(CONFIG)
    _, changed, _ = updated(replace(CONFIG, **change))
    default, changed = (
        [np.ravel(leaf) for leaf in jax.tree.leaves((s.policy.actor, s.critic))] for s in (default, changed)
    )
    default, changed = np.concatenate(default), np.concatenate(changed)
    assert default.shape != changed.shape or abs(default - changed).max() > 1e-6


def test_every_sample_is_used_equally_often_to_within_one():
    config = replace(CONFIG, num_robots=10, num_steps=3, updates_per_iteration=4, minibatch_size=11)
    rows = learner._shuffled_rows(jax.random.key(0), config.num_samples, 4, 11)
    assert rows.shape == (4, 11)
    assert set(np.bincount(rows.ravel(), minlength=30)) == {1, 2}
    np.testing.assert_array_equal(np.sort(rows.ravel()[:30]), np.arange(30))


def test_rollout_of_another_size_is_refused():
    state = learner.init(jax.random.key(0), CONFIG, 5, 3, 2)
    rollout = make_rollout(replace(CONFIG, num_robots=9), state)
    with pytest.raises(ValueError, match=r"The rollout is \(8, 9\) steps x robots; .* call for \(8, 8\) a device\."):
        learner.update(CONFIG, state, rollout, jax.random.key(1))


def test_sizes_must_be_positive():
    with pytest.raises(ValueError, match="at least 1, not 0"):
        learner.init(jax.random.key(0), CONFIG, 0, 3, 0)


TWO_DEVICES = """
from dataclasses import replace
from functools import partial
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import AxisType, PartitionSpec as P
from cassie_mjx.ppo import learner, normalizer
from test_ppo_learner import CONFIG, make_rollout

# A minibatch is the whole batch, so that how each device shuffles its own robots does not matter.
config = replace(CONFIG, minibatch_size=CONFIG.num_samples)
state = learner.init(jax.random.key(0), config, 5, 3, 2)
rollout, key = make_rollout(config, state), jax.random.key(1)
mesh = jax.make_mesh((2,), ("devices",), axis_types=(AxisType.Auto,))
share = partial(jax.shard_map, mesh=mesh, out_specs=P(), check_vma=False)

def update_on_both(config):
    return share(partial(learner.update, config, axis_name="devices"), in_specs=(P(), P(None, "devices"), P()))

alone, together = learner.update(config, state, rollout, key), update_on_both(config)(state, rollout, key)
jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-6), alone, together)
assert abs(together[0].critic["output"]["kernel"] - state.critic["output"]["kernel"]).max() > 1e-3

gather = share(partial(normalizer.update, axis_name="devices"), in_specs=(P(), P(None, "devices")))
alone, together = (add(normalizer.init(5), rollout.observation) for add in (normalizer.update, gather))
jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6), alone, together)

try:
    update_on_both(replace(config, num_robots=9))(state, rollout, key)
except ValueError as error:
    assert str(error) == "num_robots is 9; it must be a multiple of the 2 devices.", error
else:
    raise AssertionError("9 robots were spread over 2 devices")
"""


def test_two_devices_learn_what_one_does():
    environment = os.environ | {
        "XLA_FLAGS": "--xla_force_host_platform_device_count=2",
        "JAX_PLATFORMS": "cpu",
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
        "PYTHONPATH": os.pathsep.join([os.path.dirname(__file__), *sys.path]),
    }
    run = subprocess.run([sys.executable, "-c", TWO_DEVICES], env=environment, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
