"""The actor's network, from an observation to an action, for NumPy and JAX arrays alike."""

from collections.abc import Sequence
from typing import NamedTuple

from cassie_mjx.robot.arrays import Array, namespace

KIND = "perceptron, ReLU"
"""What `perceptron` is. A policy's file says so, and is refused where another kind would run it."""

Layers = Sequence[tuple[Array, Array]]
"""(W [inputs, outputs], b [outputs]) of each layer, first to last."""


class Network(NamedTuple):
    """Everything between an observation [..., O] and an action [..., A]."""

    mean: Array
    """Mean of the observations, [O]."""
    std: Array
    """Their standard deviation, [O]."""
    clip: float
    """Largest normalised input, standard deviations."""
    layers: Layers


def normalize(observation: Array, mean: Array, std: Array, clip: float) -> Array:
    """(observation - mean) / std, within +-`clip`, [..., O]."""
    return namespace(observation, mean).clip((observation - mean) / std, -clip, clip)


def perceptron(layers: Layers, x: Array) -> Array:
    """A multilayer perceptron with ReLU between its layers, [..., inputs] to [..., outputs]."""
    xp = namespace(x, layers[0][0])
    *hidden, (output, output_bias) = layers
    for weight, bias in hidden:
        x = xp.maximum(x @ weight + bias, 0)
    return x @ output + output_bias


def action(network: Network, observation: Array) -> Array:
    """The deterministic action for observations [..., O], within +-1, [..., A], rad."""
    inputs = normalize(observation, network.mean, network.std, network.clip)
    return namespace(inputs).tanh(perceptron(network.layers, inputs))
