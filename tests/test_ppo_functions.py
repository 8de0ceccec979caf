"""The learner's pure functions against numbers worked by hand, closed forms and NumPy."""

import acting
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from cassie_mjx.ppo import advantage, loss, networks, normalizer
from cassie_mjx.ppo.types import Policy


@pytest.fixture(autouse=True)
def strict_promotion():
    with jax.numpy_dtype_promotion("strict"):
        yield


# One rollout of 3 steps, gamma 0.5. The columns differ in what happens at step 1: nothing, a termination, a truncation,
# and both at once. Where the episode goes on, next_value is the next row's value; the truncated state is worth 8.
REWARD = jnp.array([[1.0] * 4, [2.0] * 4, [3.0] * 4])
VALUE = jnp.array([[4.0] * 4, [5.0] * 4, [6.0] * 4])
NEXT_VALUE = jnp.array([[5.0] * 4, [6.0, 8.0, 8.0, 8.0], [7.0] * 4])
TERMINATED = jnp.zeros((3, 4), bool).at[1, jnp.array([1, 3])].set(True)
TRUNCATED = jnp.zeros((3, 4), bool).at[1, jnp.array([2, 3])].set(True)


def test_gae_by_hand():
    # delta = [1 + 2.5 - 4, 2 + 3 - 5, 3 + 3.5 - 6] = [-0.5, 0, 0.5] where nothing ends; at step 1 it is 2 - 5 = -3
    # after a termination and 2 + 4 - 5 = 1 after a truncation. gamma lambda = 0.25 carries step 2 to step 1 only where
    # nothing ends.
    expected = [
        [-0.5 + 0.25 * 0.125, -0.5 - 0.25 * 3.0, -0.5 + 0.25 * 1.0, -0.5 - 0.25 * 3.0],
        [0.25 * 0.5, -3.0, 1.0, -3.0],
        [0.5, 0.5, 0.5, 0.5],
    ]
    estimate, target = advantage.generalized_advantage(
        REWARD, VALUE, NEXT_VALUE, TERMINATED, TRUNCATED, gamma=0.5, gae_lambda=0.5
    )
    np.testing.assert_allclose(estimate, expected, rtol=1e-6)
    np.testing.assert_allclose(target, np.asarray(expected) + np.asarray(VALUE), rtol=1e-6)


def test_lambda_1_is_the_monte_carlo_return_with_the_value_at_the_cut():
    # Step 2 is cut by the end of the rollout: 3 + 0.5 x 7 = 6.5. Step 1 earns 2, plus half of that 6.5 where nothing
    # ends, nothing after a termination, half of the truncated state's 8 after a truncation.
    expected = [[1 + 0.5 * 5.25, 1 + 0.5 * 2, 1 + 0.5 * 6, 1 + 0.5 * 2], [2 + 0.5 * 6.5, 2, 2 + 0.5 * 8, 2], [6.5] * 4]
    _, target = advantage.generalized_advantage(
        REWARD, VALUE, NEXT_VALUE, TERMINATED, TRUNCATED, gamma=0.5, gae_lambda=1.0
    )
    np.testing.assert_allclose(target, expected, rtol=1e-6)


def test_standardize():
    standardized = advantage.standardize(jnp.array([[1.0, 2.0], [3.0, 6.0]]))
    np.testing.assert_allclose(standardized, (np.array([[1, 2], [3, 6]]) - 3) / np.sqrt(3.5), rtol=1e-6)
    np.testing.assert_array_equal(advantage.standardize(jnp.full(3, 2.0)), 0.0)


@pytest.mark.parametrize(
    ("ratio", "advantage_", "expected_loss", "expected_slope"),
    [
        (1.5, 2.0, -2.4, 0.0),  # already likelier than the clip allows: nothing more to earn
        (1.5, -2.0, 3.0, 3.0),  # a mistake made likelier is paid for in full
        (0.5, 2.0, -1.0, -1.0),  # a good action made unlikelier can still be won back
        (0.5, -2.0, 1.6, 0.0),  # a mistake unlikely enough earns nothing more
        (1.1, 2.0, -2.2, -2.2),  # inside the clip interval
    ],
)
def test_clipped_surrogate_by_hand(ratio, advantage_, expected_loss, expected_slope):
    def surrogate(log_prob):
        return loss.clipped_surrogate(log_prob, jnp.zeros(1), jnp.array([advantage_]), clip_epsilon=0.2)

    value, slope = jax.value_and_grad(surrogate)(jnp.log(jnp.array([ratio])))
    np.testing.assert_allclose(value, expected_loss, rtol=1e-6)
    np.testing.assert_allclose(slope, [expected_slope], rtol=1e-6)


def test_squared_error_clip_fraction_and_explained_variance_by_hand():
    np.testing.assert_allclose(loss.squared_error(jnp.array([1.0, 2.0]), jnp.array([2.0, 5.0])), 0.5 * (1 + 9) / 2)
    log_ratio = jnp.log(jnp.array([0.7, 0.9, 1.1, 1.3]))
    np.testing.assert_allclose(loss.clip_fraction(log_ratio, jnp.zeros(4), 0.2), 0.5)
    # Targets 0, 2, 4 have variance 8/3; the residuals -1, 0, 1 have 2/3.
    explained = loss.explained_variance(jnp.array([1.0, 2.0, 3.0]), jnp.array([0.0, 2.0, 4.0]))
    np.testing.assert_allclose(explained, 1 - 2 / 8, rtol=1e-6)
    assert loss.explained_variance(jnp.array([1.0, 2.0]), jnp.array([3.0, 3.0])) == 0.0


def test_kl_estimate_agrees_with_the_closed_form_of_two_gaussians():
    std, shift = 0.134, 0.02
    action = std * jax.random.normal(jax.random.key(0), (200_000, 10))
    old = networks.log_prob(jnp.zeros_like(action), std, action)
    new = networks.log_prob(jnp.full_like(action, shift), std, action)
    np.testing.assert_allclose(loss.kl_estimate(new, old), 10 * shift**2 / (2 * std**2), rtol=0.01)


def test_log_prob_is_that_of_a_gaussian():
    mean, action = np.array([[0.1, -0.4]], np.float32), np.array([[0.3, -0.5]], np.float32)
    expected = stats.norm.logpdf(action, mean, 0.134).sum(axis=-1)
    np.testing.assert_allclose(networks.log_prob(jnp.asarray(mean), 0.134, jnp.asarray(action)), expected, rtol=1e-5)


def test_samples_have_the_mean_and_spread_asked_for_and_their_own_log_density():
    policy = _policy(output_scale=1.0)
    observation = jnp.broadcast_to(jnp.array([1.0, -2.0, 0.5]), (100_000, 3))
    action, log_prob, _ = networks.sample(policy, observation, jnp.zeros((100_000, 0)), jax.random.key(1))
    mean = acting.mode(policy, observation)
    np.testing.assert_allclose(action.mean(axis=0), mean[0], atol=0.01)
    np.testing.assert_allclose(action.std(axis=0), 0.5, rtol=0.01)
    assert abs(action).max() > 1.0  # the noise is not squashed
    np.testing.assert_allclose(log_prob, networks.log_prob(mean, 0.5, action), rtol=1e-6)


def test_layers_run_in_numpy():
    policy = _policy(output_scale=1.0)
    observation = np.array([[1.0, -2.0, 0.5], [30.0, 0.0, -40.0]], np.float32)
    (w0, b0), (w1, b1), (w2, b2) = [(np.asarray(w), np.asarray(b)) for w, b in networks.layers(policy.actor)]
    x = np.clip(observation, -10.0, 10.0)  # a normaliser that has seen nothing only clips
    x = np.maximum(np.maximum(x @ w0 + b0, 0.0) @ w1 + b1, 0.0)
    np.testing.assert_allclose(acting.mode(policy, jnp.asarray(observation)), np.tanh(x @ w2 + b2), rtol=1e-5)


def test_initial_weights_are_he_s_with_a_scaled_last_layer():
    (w0, b0), (w1, b1), (w2, b2) = networks.layers(networks.init(jax.random.key(0), 80, (256, 256), 64, 0.01))
    np.testing.assert_allclose(w0.std(), np.sqrt(2 / 80), rtol=0.02)
    np.testing.assert_allclose(w1.std(), np.sqrt(2 / 256), rtol=0.02)
    np.testing.assert_allclose(w2.std(), 0.01 * np.sqrt(2 / 256), rtol=0.02)
    for bias in (b0, b1, b2):
        np.testing.assert_array_equal(bias, 0.0)


def test_normalizer_gathers_what_numpy_computes_at_once():
    # An offset of 1,000 standard deviations: a sum of squares in float32 would lose the spread.
    data = np.random.default_rng(0).normal([0.0, 1000.0], [2.0, 1.0], (3000, 2)).astype(np.float32)
    statistics = normalizer.init(2)
    for batch in (data[:10], data[10:1200].reshape(70, 17, 2), data[1200:]):
        statistics = normalizer.update(statistics, jnp.asarray(batch))
    assert statistics.samples == 3000
    np.testing.assert_allclose(statistics.mean, data.astype(np.float64).mean(axis=0), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(normalizer.std(statistics), data.astype(np.float64).std(axis=0), rtol=1e-3)


def test_normalize_floors_the_spread_and_clips():
    statistics = normalizer.update(normalizer.init(2), jnp.array([[1.0, 5.0], [3.0, 5.0]]))
    normalized = normalizer.normalize(statistics, jnp.array([[2.5, 5.002], [100.0, 6.0]]))
    np.testing.assert_allclose(normalized, [[0.5, 2.0], [10.0, 10.0]], rtol=1e-3)
    np.testing.assert_array_equal(normalizer.normalize(normalizer.init(2), jnp.array([3.0, -4.0])), [3.0, -4.0])


def _policy(output_scale):
    actor = networks.init(jax.random.key(0), 3, (16, 16), 2, output_scale)
    return Policy(normalizer.init(3), actor, std=jnp.asarray(0.5))
