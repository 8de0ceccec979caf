"""Mean and standard deviation of the observations, gathered batch by batch and applied to the networks' inputs.

The statistics are estimated once, before training, and stay as they are (Xie et al. 2018): a policy then means the same
function of the state from its first update to its last.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cassie_mjx.ppo.types import Normalizer

STD_FLOOR = 1e-3
"""Inputs that hardly vary are not blown up: the reference quaternion's w has a standard deviation of 1.6e-4."""

CLIP = 10.0
"""Largest normalised input, standard deviations: a robot far outside the statistics must not saturate the networks."""


def init(observation_size: int) -> Normalizer:
    """Return the statistics of no observations at all, which `normalize` treats as mean 0 and standard deviation 1."""
    return Normalizer(jnp.zeros(()), jnp.zeros(observation_size), jnp.zeros(observation_size))


def update(normalizer: Normalizer, observation: Float[Array, "*batch O"], axis_name: str | None = None) -> Normalizer:
    """Add a batch of observations.

    Two sets of statistics merge as in Chan, Golub and LeVeque, "Updating formulae and a pairwise algorithm for
    computing sample variances" (1979), which keeps float32 accurate where a sum of squares would not.

    Args:
        normalizer: statistics so far.
        observation: the batch, with any number of leading axes.
        axis_name: mapped device axis over which the batch is spread, if any.
    """
    rows = observation.reshape(-1, observation.shape[-1])
    total = (lambda x: x) if axis_name is None else (lambda x: jax.lax.psum(x, axis_name))
    added = total(jnp.asarray(rows.shape[0], rows.dtype))
    batch_mean = total(rows.sum(axis=0)) / added
    batch_squares = total(jnp.square(rows - batch_mean).sum(axis=0))

    # n = n_a + n_b,  mean = mean_a + delta n_b / n,  S = S_a + S_b + delta^2 n_a n_b / n,  delta = mean_b - mean_a
    samples = normalizer.samples + added
    delta = batch_mean - normalizer.mean
    mean = normalizer.mean + delta * (added / samples)
    squares = normalizer.squares + batch_squares + jnp.square(delta) * (normalizer.samples * added / samples)
    return Normalizer(samples, mean, squares)


def std(normalizer: Normalizer) -> Float[Array, " O"]:
    """Return the standard deviation that observations are divided by: at least `STD_FLOOR`; 1 before any were seen."""
    spread = jnp.sqrt(normalizer.squares / jnp.maximum(normalizer.samples, 1.0))
    return jnp.where(normalizer.samples > 0, jnp.maximum(spread, STD_FLOOR), 1.0)


def normalize(normalizer: Normalizer, observation: Float[Array, "*batch O"]) -> Float[Array, "*batch O"]:
    """Return (observation - mean) / std, clipped to +-`CLIP`."""
    return jnp.clip((observation - normalizer.mean) / std(normalizer), -CLIP, CLIP)
