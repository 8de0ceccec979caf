"""The learner's losses, and the estimates that say how far an update went; each a mean over the samples given."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from cassie_mjx.ppo.advantage import moments


def clipped_surrogate(
    log_prob: Float[Array, " N"], old_log_prob: Float[Array, " N"], advantage: Float[Array, " N"], clip_epsilon: float
) -> Float[Array, ""]:
    """Return the actor's loss, the negative clipped surrogate of Schulman et al. 2017.

    Args:
        log_prob: of the actions under the policy being trained.
        old_log_prob: of the same actions under the policy that took them.
        advantage: of the same actions.
        clip_epsilon: the ratio earns nothing beyond 1 +- this.
    """
    # L = -E[min(rho A, clip(rho, 1 - epsilon, 1 + epsilon) A)],  rho = pi(a|s) / pi_old(a|s)
    ratio = jnp.exp(log_prob - old_log_prob)
    clipped = jnp.clip(ratio, 1.0 - clip_epsilon, 1.0 + clip_epsilon)
    return -jnp.minimum(ratio * advantage, clipped * advantage).mean()


def squared_error(value: Float[Array, " N"], value_target: Float[Array, " N"]) -> Float[Array, ""]:
    """Return the critic's loss, half the squared error."""
    return 0.5 * jnp.square(value - value_target).mean()


def kl_estimate(log_prob: Float[Array, " N"], old_log_prob: Float[Array, " N"]) -> Float[Array, ""]:
    """Estimate KL(old || new), nats, from actions of the old policy.

    The estimator is never negative and has no bias (Schulman, "Approximating KL divergence", 2020, there called k3).
    """
    # KL = E_old[(rho - 1) - log rho]
    log_ratio = log_prob - old_log_prob
    return (jnp.expm1(log_ratio) - log_ratio).mean()


def clip_fraction(
    log_prob: Float[Array, " N"], old_log_prob: Float[Array, " N"], clip_epsilon: float
) -> Float[Array, ""]:
    """Return the fraction of samples whose probability ratio lies outside 1 +- `clip_epsilon`."""
    return (jnp.abs(jnp.expm1(log_prob - old_log_prob)) > clip_epsilon).mean(dtype=log_prob.dtype)


def explained_variance(
    value: Float[Array, "..."], value_target: Float[Array, "..."], axis_name: str | None = None
) -> Float[Array, ""]:
    """Return 1 - Var[target - value] / Var[target], over all devices of `axis_name` if given; 0 for equal targets."""
    _, residual = moments(value_target - value, axis_name)
    _, spread = moments(value_target, axis_name)
    return jnp.where(spread > 0, 1.0 - residual / jnp.where(spread > 0, spread, 1.0), 0.0)
