"""The GRU and its training: the formula, the gradient through time, and a task that only a memory can do."""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cassie_mjx.control.network import Gru, remember
from cassie_mjx.ppo import learner, networks, rollout
from cassie_mjx.ppo.config import PPOConfig

ROBOTS, EPISODE = 64, 4

CONFIG = PPOConfig(
    network="gru",
    num_robots=ROBOTS,
    num_steps=8,
    iterations=60,
    updates_per_iteration=20,
    minibatch_size=256,
    hidden_sizes=(16, 16),
    gamma=0.9,
    actor_output_scale=1.0,
    actor_learning_rate=3e-3,
    critic_learning_rate=3e-3,
    final_action_std=None,
)


class CueState(NamedTuple):
    cue: Any
    age: Any
    observation: Any
    reward: Any
    terminated: Any
    truncated: Any
    final_observation: Any
    privileged: Any
    final_privileged: Any
    metrics: Any


def seen(xp, cue, age):
    """The cue in the first step of an episode, and 0 in the others; and whether it is the first."""
    first = (age == 0).astype(xp.float32)
    return xp.stack([first * cue, first], axis=1)


def reset(xp, key):
    """Robots in all steps of an episode, so that episodes do not end with rollouts; those in its middle saw nothing."""
    cue = xp.asarray(jax.random.rademacher(key, (ROBOTS,), jnp.float32))
    age, zero, none = xp.arange(ROBOTS) % EPISODE, xp.zeros(ROBOTS, xp.float32), xp.zeros(ROBOTS, bool)
    observation = seen(xp, cue, age)
    return CueState(cue, age, observation, zero, none, none, observation, cue[:, None], cue[:, None], {})


def step(xp, state, action, key):
    """What is earned is 1 less the square of how far the action is from the cue, but nothing in the first step."""
    earned = xp.where(state.age > 0, 1 - xp.square(action[:, 0] - state.cue), 0)
    ended = state.age == EPISODE - 1
    age = xp.where(ended, 0, state.age + 1)
    cue = xp.where(ended, xp.asarray(jax.random.rademacher(key, (ROBOTS,), jnp.float32)), state.cue)
    final, privileged = seen(xp, state.cue, state.age + 1), (cue[:, None], state.cue[:, None])
    return CueState(cue, age, seen(xp, cue, age), earned, ended, xp.zeros_like(ended), final, *privileged, {})


COLLECT = {
    "scan": partial(rollout.collect, partial(step, jnp), CONFIG),
    "host": partial(rollout.collect_on_host, partial(step, np), CONFIG),
}
RESET = {"scan": partial(reset, jnp), "host": partial(reset, np)}
LOOPS = ("scan", "host")


@pytest.mark.parametrize("xp", [np, jnp])
def test_the_gru_by_hand(xp):
    """x = 1, h = 2: z = sigma(ln 3) = 3/4, r = sigma(0) = 1/2, n = tanh(1/4 + 1/2 (1/2 x 2 + 1/2)) = tanh(1)."""
    cell = Gru(*map(xp.asarray, ([[np.log(3), 0.0, 0.25]], [[0.0, 0.0, 0.5]], [0.0, 0.0, 0.0], [0.5])))
    # h' = 1/4 tanh(1) + 3/4 x 2, tanh(1) = 0.7615942
    np.testing.assert_allclose(remember(cell, xp.ones((1, 1)), 2 * xp.ones((1, 1))), [[1.6903985]], rtol=1e-6)


def test_the_gru_is_flaxs():
    rng = np.random.default_rng(0)
    cell = Gru(*(jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in ((3, 15), (5, 15), (15,), (5,))))
    x, hidden = (jnp.asarray(rng.normal(size=(7, n)), jnp.float32) for n in (3, 5))
    (wz, wr, wn), (uz, ur, un) = (np.split(matrix, 3, axis=1) for matrix in (cell.kernel, cell.recurrent))
    bz, br, bn = np.split(cell.bias, 3)
    params = {"iz": {"kernel": wz, "bias": bz}, "ir": {"kernel": wr, "bias": br}, "in": {"kernel": wn, "bias": bn}}
    params |= {"hz": {"kernel": uz}, "hr": {"kernel": ur}, "hn": {"kernel": un, "bias": cell.recurrent_bias}}
    expected, _ = nn.GRUCell(5).apply({"params": params}, hidden, x)  # pyright: ignore[reportGeneralTypeIssues]
    np.testing.assert_allclose(remember(cell, x, hidden), expected, rtol=1e-5, atol=1e-6)


@pytest.fixture(scope="module")
def lived():
    """A rollout that begins where another ended, by either loop, and the learner that collected it."""
    state, found = learner.init(jax.random.key(0), CONFIG, 2, 1, 1), {}
    for loop in LOOPS:
        robots = rollout.begin(state.policy, RESET[loop](jax.random.key(1)))
        robots, _ = COLLECT[loop](state.policy, robots, jax.random.key(2))
        found[loop] = COLLECT[loop](state.policy, robots, jax.random.key(3))
    return state, found


@pytest.mark.parametrize("loop", LOOPS)
def test_what_is_carried_is_0_where_an_episode_begins_and_there_alone(lived, loop):
    _, found = lived
    robots, experience = found[loop]
    begins = np.asarray(experience.observation[..., 1] == 1)
    carried = np.concatenate([experience.hidden, np.asarray(robots.hidden)[None]])
    begins = np.concatenate([begins, np.asarray(robots.env.observation[:, 1] == 1)[None]])
    assert begins[0].sum() == begins[-1].sum() == ROBOTS // EPISODE
    np.testing.assert_array_equal((carried == 0).all(axis=-1), begins)


def test_both_loops_live_the_same_rollout(lived):
    _, found = lived
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-5), found["scan"], found["host"])
    assert isinstance(found["host"][0].hidden, np.ndarray)


@pytest.mark.parametrize("loop", LOOPS)
def test_the_learner_finds_the_densities_that_were_collected(lived, loop):
    """It runs the network anew from what was carried into the rollout, through the ends of episodes."""
    state, found = lived
    batch, _ = learner._prepare(CONFIG, state, found[loop][1], None)
    assert batch.inputs.shape == (ROBOTS, CONFIG.num_steps, 2)
    np.testing.assert_allclose(learner._log_prob(state.policy, batch), batch.log_prob, rtol=1e-4, atol=1e-4)


def test_the_gradient_goes_back_through_time_to_the_start_of_the_episode():
    """Slope of the last action by the inputs of each step; the second of two episodes begins at step 3 of 6."""
    state = learner.init(jax.random.key(0), CONFIG, 2, 1, 1)
    inputs = jnp.asarray(np.random.default_rng(0).normal(size=(1, 6, 2)), jnp.float32)
    ended = jnp.arange(6)[None] == 2

    def last_action(inputs):
        return networks.actor_mean(state.policy.actor, inputs, jnp.ones((1, 6, 16)), ended)[0, -1, 0]

    slope = np.abs(jax.grad(last_action)(inputs))[0].max(axis=1)
    assert (slope[3:] > 1e-4).all()
    assert (slope[:3] == 0).all()
    # The slope that was found is that of the function.
    move = jnp.zeros_like(inputs).at[0, 3].set(1e-2)
    rise = (last_action(inputs + move) - last_action(inputs - move)) / 2e-2
    np.testing.assert_allclose(rise, jax.grad(last_action)(inputs)[0, 3].sum(), rtol=1e-2)


def test_minibatches_are_of_whole_sequences(monkeypatch):
    config = replace(CONFIG, updates_per_iteration=4, minibatch_size=128)
    state = learner.init(jax.random.key(0), config, 2, 1, 1)
    robots = rollout.begin(state.policy, RESET["host"](jax.random.key(1)))
    _, experience = COLLECT["host"](state.policy, robots, jax.random.key(2))
    asked, shuffled_rows = [], learner._shuffled_rows
    monkeypatch.setattr(
        learner, "_shuffled_rows", lambda key, *sizes: asked.append(sizes) or shuffled_rows(key, *sizes)
    )
    learner.update(config, state, experience, jax.random.key(3))
    # 64 robots, 4 updates, 16 robots with 8 steps each in a minibatch of 128.
    assert asked == [(ROBOTS, 4, 16)]


def earned(config):
    """Mean reward of the steps that earn, of the deterministic policy after training."""
    state = learner.init(jax.random.key(0), config, 2, 1, 1)
    collect = partial(rollout.collect, COLLECT["scan"].args[0], config)
    robots = rollout.begin(state.policy, RESET["scan"](jax.random.key(1)))
    for iteration in range(config.iterations):
        collect_key, update_key = jax.random.split(jax.random.fold_in(jax.random.key(2), iteration))
        robots, experience = collect(state.policy, robots, collect_key)
        state, _ = learner.update(config, state, experience, update_key)
    quiet = state.policy._replace(std=jnp.zeros(()))
    _, experience = collect(quiet, robots, jax.random.key(3))
    return float(experience.reward.mean()) * EPISODE / (EPISODE - 1)


def test_a_recurrent_policy_learns_what_no_other_can():
    """The best without memory is to do nothing, which earns 0; to know the cue earns 1."""
    assert earned(CONFIG) > 0.9
    assert earned(replace(CONFIG, network="mlp", iterations=20)) < 0.05


def test_a_batch_that_does_not_divide_into_sequences_is_refused():
    with pytest.raises(
        ValueError, match=r"^minibatch_size=100 must be a multiple of num_steps=8 with network=gru, which"
    ):
        replace(CONFIG, minibatch_size=100)
    with pytest.raises(
        ValueError, match=r"^minibatch_size is 8; .* multiple of num_steps=8 on each of the 2 devices\.$"
    ):
        learner.check_devices(replace(CONFIG, minibatch_size=8), 2)
