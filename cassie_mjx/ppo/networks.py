"""Actor and critic, and the Gaussian policy that the actor is the mean of."""

import math
from typing import cast

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from cassie_mjx.control.network import Network, action
from cassie_mjx.ppo import normalizer
from cassie_mjx.ppo.types import Normalizer, Params, Policy


class MLP(nn.Module):
    """Dense layers with ReLU between them, He-initialised (He et al. 2015), zero bias."""

    widths: tuple[int, ...]
    """Outputs of each layer, first to last; the last layer is linear."""
    output_scale: float = 1.0
    """Factor on the initial weights of the last layer."""

    @nn.compact
    def __call__(self, x: Float[Array, "*batch inputs"]) -> Float[Array, "*batch outputs"]:
        """Apply the layers; parameters are named hidden_0, hidden_1, ... and output."""
        *hidden, outputs = self.widths
        for i, width in enumerate(hidden):
            x = nn.relu(nn.Dense(width, kernel_init=nn.initializers.he_normal(), name=f"hidden_{i}")(x))
        scaled_he = nn.initializers.variance_scaling(2.0 * self.output_scale**2, "fan_in", "truncated_normal")
        return nn.Dense(outputs, kernel_init=scaled_he, name="output")(x)


def init(
    key: Key[Array, ""], inputs: int, hidden_sizes: tuple[int, ...], outputs: int, output_scale: float = 1.0
) -> Params:
    """Draw the parameters of a network with `inputs` inputs, ReLU layers of `hidden_sizes` and `outputs` outputs."""
    return MLP((*hidden_sizes, outputs), output_scale).init(key, jnp.zeros(inputs))["params"]


def layers(params: Params) -> list[tuple[Array, Array]]:
    """Return (W [inputs, outputs], b [outputs]) of each layer, first to last: enough to run the network elsewhere."""
    hidden = [params[f"hidden_{i}"] for i in range(len(params) - 1)]
    return [(layer["kernel"], layer["bias"]) for layer in (*hidden, params["output"])]


def actor_mean(params: Params, inputs: Float[Array, "*batch O"]) -> Float[Array, "*batch A"]:
    """Return the mean action, within +-1, for normalised observations."""
    return jnp.tanh(_apply(params, inputs))


def critic_value(params: Params, inputs: Float[Array, "*batch O"]) -> Float[Array, "*batch"]:
    """Return the value for normalised observations."""
    return _apply(params, inputs).squeeze(-1)


def acting(policy: Policy) -> Network:
    """Return the actor with its input statistics, as `control.network` runs it."""
    statistics = policy.normalizer
    return Network(statistics.mean, normalizer.std(statistics), normalizer.CLIP, layers(policy.actor))


def mode(policy: Policy, observation: Float[Array, "*batch O"]) -> Float[Array, "*batch A"]:
    """Return the deterministic action, which is the mean."""
    return action(acting(policy), observation)


def renormalize(policy: Policy, statistics: Normalizer) -> Policy:
    """Return the policy with other input statistics and a first layer that makes up for them.

    It is the same function of the observation, except where inputs were clipped, or are now.

    Args:
        policy: to be changed.
        statistics: of the observations of another task.
    """
    # W z + b with z = (x - m) / s is W' z' + b' with z' = (x - m') / s': W' = W s' / s, b' = b + W (m' - m) / s.
    before, after = policy.normalizer, statistics
    mean, std = (np.asarray(x, np.float64) for x in (before.mean, normalizer.std(before)))
    new_mean, new_std = (np.asarray(x, np.float64) for x in (after.mean, normalizer.std(after)))
    first = next(iter(sorted(policy.actor)))
    kernel, bias = (np.asarray(policy.actor[first][name], np.float64) for name in ("kernel", "bias"))
    layer = {
        "kernel": jnp.asarray(kernel * (new_std / std)[:, None], jnp.float32),
        "bias": jnp.asarray(bias + ((new_mean - mean) / std) @ kernel, jnp.float32),
    }
    return policy._replace(normalizer=statistics, actor={**policy.actor, first: layer})


def sample(
    policy: Policy, observation: Float[Array, "*batch O"], key: Key[Array, ""]
) -> tuple[Float[Array, "*batch A"], Float[Array, "*batch"]]:
    """Draw an action, mean + std x noise; the noise is not squashed, so an action may leave +-1.

    Args:
        policy: normaliser, actor and width.
        observation: as the environment gives it.
        key: used up here.

    Returns:
        The action and its log density.
    """
    mean = mode(policy, observation)
    action = mean + policy.std * jax.random.normal(key, mean.shape, mean.dtype)
    return action, log_prob(mean, policy.std, action)


def log_prob(
    mean: Float[Array, "*batch A"], std: float | Float[Array, ""], action: Float[Array, "*batch A"]
) -> Float[Array, "*batch"]:
    """Return the log density of `action` under a Gaussian with standard deviation `std` on every axis, nats."""
    # log N(a; mu, sigma^2 I) = -|a - mu|^2 / (2 sigma^2) - A log(sigma sqrt(2 pi))
    squares = jnp.square((action - mean) / std).sum(axis=-1)
    return -0.5 * squares - action.shape[-1] * (jnp.log(std) + 0.5 * math.log(2.0 * math.pi))


def _apply(params: Params, x: Float[Array, "*batch inputs"]) -> Float[Array, "*batch outputs"]:
    widths = tuple(bias.shape[0] for _, bias in layers(params))
    return cast(Array, MLP(widths).apply({"params": params}, x))
