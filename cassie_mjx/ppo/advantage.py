"""Advantages and value targets from a rollout's rewards and the critic's values."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree


def generalized_advantage(
    reward: Float[Array, "T B"],
    value: Float[Array, "T B"],
    next_value: Float[Array, "T B"],
    terminated: Bool[Array, "T B"],
    truncated: Bool[Array, "T B"],
    gamma: float,
    gae_lambda: float,
) -> tuple[Float[Array, "T B"], Float[Array, "T B"]]:
    """Generalised advantage estimation (Schulman et al. 2016) over episodes that end inside the rollout.

    A termination cuts the bootstrap: nothing follows. A truncation keeps it, and so does the last row: the critic's
    value of the state reached, before any reset, stands for what would have followed. Neither lets a later episode
    leak back.

    With `gae_lambda` 1 the target is the Monte-Carlo return with the critic's value at the cut,
    R_t = sum_{k<n} gamma^k r_{t+k} + gamma^n V(s_{t+n}). Xie et al. 2018 print that last term undiscounted; it is
    discounted here, so that where a rollout happens to be cut does not change what is estimated.

    Args:
        reward: of each step.
        value: the critic's at the observation acted on.
        next_value: the critic's at the observation the step led to, before any reset.
        terminated: the step ended its episode in failure.
        truncated: the step met a time limit. A step that did both counts as terminated.
        gamma: discount per step.
        gae_lambda: weight of longer looks ahead, 0 to 1.

    Returns:
        Advantage and value target.
    """
    # delta_t = r_t + gamma V(s_{t+1}) - V(s_t)
    delta = reward + gamma * jnp.where(terminated, 0.0, next_value) - value
    carry_on = jnp.where(terminated | truncated, 0.0, gamma * gae_lambda)

    def backwards(
        later: Float[Array, " B"], step: tuple[Float[Array, " B"], Float[Array, " B"]]
    ) -> tuple[Float[Array, " B"], Float[Array, " B"]]:
        # A_t = delta_t + gamma lambda A_{t+1}
        delta_t, carry_on_t = step
        advantage_t = delta_t + carry_on_t * later
        return advantage_t, advantage_t

    _, advantage = jax.lax.scan(backwards, jnp.zeros_like(delta[0]), (delta, carry_on), reverse=True)
    return advantage, advantage + value


def standardize(x: Float[Array, "..."], axis_name: str | None = None) -> Float[Array, "..."]:
    """Bring `x` to mean 0 and standard deviation 1 over all its entries, on all devices of `axis_name` if given."""
    mean, variance = moments(x, axis_name)
    # 1e-8: entries that are all equal become 0, not NaN.
    return (x - mean) / (jnp.sqrt(variance) + 1e-8)


def moments(x: Float[Array, "..."], axis_name: str | None = None) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return mean and variance of all entries of `x`, on all devices of `axis_name` if given."""
    mean = average(x.mean(), axis_name)
    return mean, average(jnp.square(x - mean).mean(), axis_name)


def average(tree: PyTree, axis_name: str | None) -> PyTree:
    """Return the mean of a pytree over the devices of `axis_name`; the pytree itself if that is None."""
    return tree if axis_name is None else jax.lax.pmean(tree, axis_name)
