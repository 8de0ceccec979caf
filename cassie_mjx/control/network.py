"""The actor's network, from an observation to an action, for NumPy and JAX arrays alike."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cassie_mjx.robot.arrays import Array, namespace

KIND = "perceptron, ReLU"
"""What `perceptron` is. A policy's file says so, and is refused where another kind would run it."""
RECURRENT_KIND = f"GRU, {KIND}"
"""What a network with a memory is: `remember`, then `perceptron`."""

Layers = Sequence[tuple[Array, Array]]
"""(W [inputs, outputs], b [outputs]) of each layer, first to last."""


class Gru(NamedTuple):
    """A gated recurrent unit of N numbers; update gate, reset gate and candidate side by side, as ONNX orders them."""

    kernel: Array
    """W, from what it is given, [inputs, 3 N]."""
    recurrent: Array
    """U, from what it carries, [N, 3 N]."""
    bias: Array
    """b, [3 N]."""
    recurrent_bias: Array
    """c, what the reset gate multiplies besides, [N]."""


class Network(NamedTuple):
    """Everything between an observation [..., O] and an action [..., A]."""

    mean: Array
    """Mean of the observations, [O]."""
    std: Array
    """Their standard deviation, [O]."""
    clip: float
    """Largest normalised input, standard deviations."""
    layers: Layers
    gru: Gru | None = None
    """What comes before the layers and remembers; None in a network without memory."""


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


def remember(gru: Gru, x: Array, hidden: Array) -> Array:
    """What a gated recurrent unit gives and carries on, [..., N], for inputs [..., I] and what it carried [..., N].

    Cho et al. 2014, "Learning Phrase Representations using RNN Encoder-Decoder", with the reset gate after the matrix
    U_n and a bias of its own there: as flax's `GRUCell`, cuDNN and ONNX's `GRU` with `linear_before_reset=1`.
    """
    xp, size = namespace(x, gru.kernel), gru.recurrent.shape[0]
    given, carried = x @ gru.kernel + gru.bias, hidden @ gru.recurrent
    # z = sigma(W_z x + b_z + U_z h),  r = sigma(W_r x + b_r + U_r h);  sigma(a) = (1 + tanh(a / 2)) / 2 cannot overflow
    gates = 0.5 + 0.5 * xp.tanh(0.5 * (given[..., : 2 * size] + carried[..., : 2 * size]))
    update, reset = gates[..., :size], gates[..., size:]
    # n = tanh(W_n x + b_n + r (U_n h + c)),  h' = (1 - z) n + z h
    candidate = xp.tanh(given[..., 2 * size :] + reset * (carried[..., 2 * size :] + gru.recurrent_bias))
    return (1 - update) * candidate + update * hidden


def start(network: Network, robots: int) -> Array:
    """What a network carries of robots of which it remembers nothing, [robots, N]: 0; N is 0 without memory."""
    return np.zeros((robots, 0 if network.gru is None else network.gru.recurrent.shape[0]), np.float32)


def forgotten(hidden: Array, ended: Array) -> Array:
    """What is carried of robots [B, N], and 0 where an episode has ended, [B], bool."""
    xp = namespace(hidden, ended)
    return xp.where(ended[:, None], xp.zeros_like(hidden), hidden)


def action(network: Network, observation: Array, hidden: Array) -> tuple[Array, Array]:
    """The deterministic action, within +-1, [..., A], rad, and what the network carries on, [..., N].

    Args:
      network: the actor.
      observation: of now, [..., O].
      hidden: of `start` or the last action, [..., N].
    """
    x = normalize(observation, network.mean, network.std, network.clip)
    if network.gru is not None:
        x = hidden = remember(network.gru, x, hidden)
    return namespace(x).tanh(perceptron(network.layers, x)), hidden
