"""Both rollout loops, on one environment written once for JAX and NumPy: a point to be driven to the origin."""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import acting
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cassie_mjx.ppo import learner, rollout
from cassie_mjx.ppo.config import PPOConfig
from cassie_mjx.ppo.types import Rollout

ROBOTS, TIME_LIMIT, REACH, STRIDE = 64, 12, 1.5, 0.3

CONFIG = PPOConfig(
    num_robots=ROBOTS,
    num_steps=16,
    iterations=40,
    updates_per_iteration=20,
    minibatch_size=256,
    hidden_sizes=(32, 32),
    gamma=0.9,
    actor_learning_rate=3e-3,
    critic_learning_rate=3e-3,
    normalizer_samples=2000,
    final_action_std=None,
)


class PointState(NamedTuple):
    position: Any
    age: Any
    observation: Any
    reward: Any
    terminated: Any
    truncated: Any
    final_observation: Any
    privileged: Any
    final_privileged: Any
    metrics: Any


def start(key):
    return jax.random.uniform(key, (ROBOTS, 2), minval=-1.0, maxval=1.0)


def reset(xp, key):
    position, none = xp.asarray(start(key)), xp.zeros(ROBOTS, bool)
    zero = xp.zeros(ROBOTS, xp.float32)
    age = xp.zeros(ROBOTS, xp.int32)
    old = age[:, None]
    return PointState(position, age, position, zero, none, none, position, old, old, {"distance": zero})


def step(xp, state, action, key):
    """Move by 0.3 x action; being 1.5 away on an axis is a failure, 12 steps the time limit; a reset follows either."""
    reached = (state.position + np.float32(STRIDE) * action).astype(xp.float32)
    squares = (reached**2).sum(axis=-1)
    terminated = (abs(reached) > REACH).any(axis=-1)
    truncated = ~terminated & (state.age + 1 >= TIME_LIMIT)
    ended = terminated | truncated
    position = xp.where(ended[:, None], xp.asarray(start(key)), reached)
    age = xp.where(ended, 0, state.age + 1).astype(xp.int32)
    ages, distance = (age[:, None], (state.age + 1)[:, None]), {"distance": squares**0.5}
    return PointState(position, age, position, 1 - squares, terminated, truncated, reached, *ages, distance)


# One object each: `collect` compiles once per `step` it is given.
RESET = {"scan": partial(reset, jnp), "host": partial(reset, np)}
COLLECT = {
    "scan": partial(rollout.collect, partial(step, jnp), CONFIG),
    "host": partial(rollout.collect_on_host, partial(step, np), CONFIG),
}
LOOPS = ("scan", "host")


def train(loop: str, seed: int) -> tuple[learner.LearnerState, list[learner.UpdateMetrics]]:
    init_key, reset_key, statistics_key, run_key = jax.random.split(jax.random.key(seed), 4)
    state = learner.init(init_key, CONFIG, 2, 2, 1)
    robots = rollout.begin(state.policy, RESET[loop](reset_key))
    normalizer = rollout.random_policy_statistics(
        COLLECT[loop], state.policy, robots, statistics_key, CONFIG.normalizer_samples
    )
    state = state._replace(policy=state.policy._replace(normalizer=normalizer))
    history = []
    for iteration in range(CONFIG.iterations):
        collect_key, update_key = jax.random.split(jax.random.fold_in(run_key, iteration))
        robots, experience = COLLECT[loop](state.policy, robots, collect_key)
        state, metrics = learner.update(CONFIG, state, experience, update_key)
        history.append(metrics)
    return state, history


@pytest.fixture(scope="module")
def rollouts() -> dict[str, Rollout]:
    # Louder than an untrained actor, so that episodes end in both ways.
    policy = learner.init(jax.random.key(0), replace(CONFIG, actor_output_scale=1.0), 2, 2, 1).policy
    start = {loop: rollout.begin(policy, RESET[loop](jax.random.key(1))) for loop in LOOPS}
    return {loop: COLLECT[loop](policy, start[loop], jax.random.key(2))[1] for loop in LOOPS}


def test_both_loops_live_the_same_rollout(rollouts):
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-5), rollouts["scan"], rollouts["host"])
    assert isinstance(rollouts["host"].reward, np.ndarray)


@pytest.mark.parametrize("loop", LOOPS)
def test_final_observation_is_the_one_before_the_reset(rollouts, loop):
    lived = jax.tree.map(np.asarray, rollouts[loop])
    ended = lived.terminated | lived.truncated
    assert lived.terminated.any()
    assert lived.truncated.any()
    assert not (lived.terminated & lived.truncated).any()
    np.testing.assert_allclose(lived.final_observation, lived.observation + STRIDE * lived.action, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal((abs(lived.final_observation) > REACH).any(axis=-1), lived.terminated)
    follows = (lived.final_observation[:-1] == lived.observation[1:]).all(axis=-1)
    np.testing.assert_array_equal(follows, ~ended[:-1])
    np.testing.assert_array_equal(lived.final_privileged, lived.privileged + 1)
    np.testing.assert_array_equal(lived.privileged[1:, :, 0] == 0, ended[:-1])


@pytest.mark.parametrize("loop", LOOPS)
def test_an_episode_cut_by_time_is_worth_what_the_critic_sees_before_the_reset(rollouts, loop):
    """A critic whose value is the age: 12 at the time limit, and 0 for the reset robot. Lambda 1 makes targets sums."""
    config = replace(CONFIG, hidden_sizes=(1,), gae_lambda=1.0, normalize_advantage=False)
    state = learner.init(jax.random.key(0), config, 2, 2, 1)
    age_alone = {"kernel": jnp.zeros((3, 1)).at[2, 0].set(1.0), "bias": jnp.zeros(1)}
    state = state._replace(critic={"hidden_0": age_alone, "output": {"kernel": jnp.ones((1, 1)), "bias": jnp.zeros(1)}})
    lived = rollouts[loop]
    target = np.asarray(learner._prepare(config, state, lived, None)[0].value_target).reshape(lived.reward.shape)

    robot = int(np.asarray(lived.truncated).any(axis=0).argmax())
    (end,) = np.flatnonzero(np.asarray(lived.truncated)[:, robot])[:1]
    assert end < CONFIG.num_steps - 1
    reward = np.asarray(lived.reward)[:, robot]
    np.testing.assert_allclose(target[end, robot], reward[end] + 0.9 * TIME_LIMIT, rtol=1e-5)
    np.testing.assert_allclose(
        target[end - 1, robot], reward[end - 1] + 0.9 * reward[end] + 0.81 * TIME_LIMIT, rtol=1e-5
    )
    failed = np.asarray(lived.terminated)
    np.testing.assert_allclose(target[failed], np.asarray(lived.reward)[failed], rtol=1e-5)


@pytest.mark.parametrize("loop", LOOPS)
def test_rollout_carries_the_density_of_its_actions_and_the_environments_metrics(rollouts, loop):
    lived = rollouts[loop]
    assert lived.observation.shape == (CONFIG.num_steps, ROBOTS, 2)
    assert lived.log_prob.shape == lived.reward.shape == (CONFIG.num_steps, ROBOTS)
    np.testing.assert_allclose(lived.metrics["distance"], np.linalg.norm(lived.final_observation, axis=-1), rtol=1e-5)


def test_statistics_of_the_random_policy_are_those_of_its_states():
    state = learner.init(jax.random.key(0), CONFIG, 2, 2, 1)
    robots = rollout.begin(state.policy, RESET["host"](jax.random.key(1)))
    normalizer = rollout.random_policy_statistics(COLLECT["host"], state.policy, robots, jax.random.key(2), 100_000)
    assert 100_000 <= normalizer.samples < 100_000 + CONFIG.num_samples
    # A start uniform on +-1 has variance 1/3; the noise adds (0.3 x 0.134)^2 a step over 0 to 11 steps, 5.5 on average.
    variance = 1 / 3 + 5.5 * (STRIDE * CONFIG.action_std) ** 2
    np.testing.assert_allclose(normalizer.mean, 0.0, atol=0.03)
    np.testing.assert_allclose(normalizer.squares / normalizer.samples, variance, rtol=0.03)


def test_environment_of_another_width_is_refused():
    policy = learner.init(jax.random.key(0), CONFIG, 3, 2, 1).policy
    for loop in LOOPS:
        with pytest.raises(ValueError, match=r"observes 2 numbers a robot; this policy was made for 3\."):
            COLLECT[loop](policy, rollout.begin(policy, RESET[loop](jax.random.key(1))), jax.random.key(2))


@pytest.mark.parametrize("loop", LOOPS)
def test_learner_drives_the_point_to_the_origin(loop):
    state, history = train(loop, seed=0)
    # The best an action within +-1 can do is to head straight for the origin, 0.3 a step and axis.
    best = _mean_reward(lambda position: np.clip(-position / STRIDE, -1.0, 1.0))
    untrained = _mean_reward(np.zeros_like)
    trained = _mean_reward(partial(jax.jit(acting.mode), state.policy))
    assert (trained - untrained) / (best - untrained) > 0.95
    assert history[-1].explained_variance > 0.3
    assert history[-1].terminated == 0.0
    assert int(state.iteration) == CONFIG.iterations


def test_same_seed_learns_the_same_bits():
    first, second, other = (train("scan", seed)[0] for seed in (3, 3, 4))
    jax.tree.map(np.testing.assert_array_equal, first, second)
    assert any(
        (a != b).any() for a, b in zip(jax.tree.leaves(first.critic), jax.tree.leaves(other.critic), strict=True)
    )


def _mean_reward(policy) -> float:
    state, rewards = RESET["host"](jax.random.key(9)), []
    for _ in range(TIME_LIMIT):
        state = step(np, state, np.asarray(policy(state.observation)), jax.random.key(0))
        rewards.append(state.reward)
    return float(np.mean(rewards))
