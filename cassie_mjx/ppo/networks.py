"""Actor and critic, and the Gaussian policy that the actor is the mean of."""

import math
from typing import cast

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from cassie_mjx.control.network import Gru, Network, action, forgotten, remember
from cassie_mjx.ppo import normalizer
from cassie_mjx.ppo.types import Normalizer, Params, Policy

GRU = "gru"
"""The layer of an actor's parameters that remembers, if it has one."""


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


def init_recurrent(
    key: Key[Array, ""], inputs: int, hidden_sizes: tuple[int, ...], outputs: int, output_scale: float = 1.0
) -> Params:
    """Draw the parameters of a network whose first layer is a GRU; the other layers as `init` draws them.

    W is drawn as LeCun et al. 1998, each U orthogonal as Saxe et al. 2014, biases are 0: flax's choice for a GRU.
    """
    kernel_key, recurrent_key, rest_key = jax.random.split(key, 3)
    size, *rest = hidden_sizes
    orthogonal = nn.initializers.orthogonal()
    gru = Gru(
        kernel=nn.initializers.lecun_normal()(kernel_key, (inputs, 3 * size)),
        recurrent=jnp.hstack([orthogonal(each, (size, size)) for each in jax.random.split(recurrent_key, 3)]),
        bias=jnp.zeros(3 * size),
        recurrent_bias=jnp.zeros(size),
    )
    return {GRU: gru._asdict(), **init(rest_key, size, tuple(rest), outputs, output_scale)}


def gru(params: Params) -> Gru | None:
    """Return the GRU of an actor; None if it has none."""
    return Gru(**params[GRU]) if GRU in params else None


def layers(params: Params) -> list[tuple[Array, Array]]:
    """Return (W [inputs, outputs], b [outputs]) of each layer but a GRU, first to last."""
    hidden = [params[f"hidden_{i}"] for i in range(len(params.keys() - {GRU}) - 1)]
    return [(layer["kernel"], layer["bias"]) for layer in (*hidden, params["output"])]


def actor_mean(
    params: Params, inputs: Float[Array, "*batch O"], hidden: Float[Array, "*batch N"], ended: Bool[Array, "*batch"]
) -> Float[Array, "*batch A"]:
    """Return the mean action, within +-1.

    Args:
        params: of the actor.
        inputs: normalised observations. For a recurrent actor the axes are robots and T control steps.
        hidden: what the actor carried when it acted; that of the first step alone counts.
        ended: whether the step was the last of its episode: what follows begins with nothing carried.
    """
    cell = gru(params)
    if cell is not None:
        inputs = _lived_through(cell, inputs, hidden[:, 0], ended)
    return jnp.tanh(_apply(params, inputs))


def critic_value(params: Params, inputs: Float[Array, "*batch O"]) -> Float[Array, "*batch"]:
    """Return the value for normalised observations."""
    return _apply(params, inputs).squeeze(-1)


def acting(policy: Policy) -> Network:
    """Return the actor with its input statistics, as `control.network` runs it."""
    statistics = policy.normalizer
    gru_layer, rest = gru(policy.actor), layers(policy.actor)
    return Network(statistics.mean, normalizer.std(statistics), normalizer.CLIP, rest, gru_layer)


def mode(
    policy: Policy, observation: Float[Array, "*batch O"], hidden: Float[Array, "*batch N"]
) -> tuple[Float[Array, "*batch A"], Float[Array, "*batch N"]]:
    """Return the deterministic action, which is the mean, and what the policy carries on."""
    return action(acting(policy), observation, hidden)


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
        **policy.actor[first],
        "kernel": jnp.asarray(kernel * (new_std / std)[:, None], jnp.float32),
        "bias": jnp.asarray(bias + ((new_mean - mean) / std) @ kernel, jnp.float32),
    }
    return policy._replace(normalizer=statistics, actor={**policy.actor, first: layer})


def sample(
    policy: Policy, observation: Float[Array, "*batch O"], hidden: Float[Array, "*batch N"], key: Key[Array, ""]
) -> tuple[Float[Array, "*batch A"], Float[Array, "*batch"], Float[Array, "*batch N"]]:
    """Draw an action, mean + std x noise; the noise is not squashed, so an action may leave +-1.

    Args:
        policy: normaliser, actor and width.
        observation: as the environment gives it.
        hidden: what the policy carries.
        key: used up here.

    Returns:
        The action, its log density, and what the policy carries on.
    """
    mean, hidden = mode(policy, observation, hidden)
    action = mean + policy.std * jax.random.normal(key, mean.shape, mean.dtype)
    return action, log_prob(mean, policy.std, action), hidden


def log_prob(
    mean: Float[Array, "*batch A"], std: float | Float[Array, ""], action: Float[Array, "*batch A"]
) -> Float[Array, "*batch"]:
    """Return the log density of `action` under a Gaussian with standard deviation `std` on every axis, nats."""
    # log N(a; mu, sigma^2 I) = -|a - mu|^2 / (2 sigma^2) - A log(sigma sqrt(2 pi))
    squares = jnp.square((action - mean) / std).sum(axis=-1)
    return -0.5 * squares - action.shape[-1] * (jnp.log(std) + 0.5 * math.log(2.0 * math.pi))


def _lived_through(
    cell: Gru, inputs: Float[Array, "B T O"], hidden: Float[Array, "B N"], ended: Bool[Array, "B T"]
) -> Float[Array, "B T N"]:
    """What a GRU gave at each of T control steps that began with `hidden`, 0 after the end of an episode."""

    def step(
        hidden: Float[Array, "B N"], now: tuple[Float[Array, "B O"], Bool[Array, " B"]]
    ) -> tuple[Float[Array, "B N"], Float[Array, "B N"]]:
        given = remember(cell, now[0], hidden)
        return forgotten(given, now[1]), given

    _, given = jax.lax.scan(step, hidden, (inputs.swapaxes(0, 1), ended.swapaxes(0, 1)))
    return given.swapaxes(0, 1)


def _apply(params: Params, x: Float[Array, "*batch inputs"]) -> Float[Array, "*batch outputs"]:
    widths = tuple(bias.shape[0] for _, bias in layers(params))
    return cast(Array, MLP(widths).apply({"params": params}, x))
