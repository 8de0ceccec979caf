"""The arrays of a policy's file: their names, and what they mean, on NumPy alone."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cassie_mjx.control.network import RECURRENT_KIND, Gru

_ARRAYS = ("mean", "std", "reference_qpos", "reference_qvel", "p_gain", "d_gain")
_NUMBERS = ("clip", "samples", "speed", "reference_stride_length")
_LISTS = ("joints", "observation")
_FIRST_KIND = "perceptron, ReLU"  # of files that do not say which


class Mirror(NamedTuple):
    """How a policy that learned one of the stride's two steps takes the other: it sees and acts as in a mirror.

    A reflection p is a list of integers: entry k of the image is sign(p[k]) times entry |p[k]| of the original, counted
    from 1.
    """

    observation: np.ndarray
    """[O], the reflection of an observation."""
    action: np.ndarray
    """[10], the reflection of an action."""
    sides: np.ndarray
    """[2], where an observation has the reference's hip pitch angles, left and right, counted from 1. In the second
    step the left one is less than the right one."""

    def second_step(self, observation: np.ndarray) -> np.ndarray:
        """Which observations [..., O] are of the second step, [..., 1], bool."""
        left, right = self.sides - 1
        return (observation[..., left] < observation[..., right])[..., None]


GRU_ARRAYS = tuple(f"gru_{name}" for name in Gru._fields)
"""Arrays that the file of a recurrent policy has besides."""
MIRROR_ARRAYS = tuple(f"mirror_{name}" for name in Mirror._fields)
"""Arrays that the file of a policy with a mirror has besides."""


def kind(content: Mapping[str, np.ndarray]) -> str:
    """What a file says that its network is."""
    return str(content.get("network", _FIRST_KIND))


def check_names(content: Mapping[str, np.ndarray], path: Path) -> None:
    """Raise ValueError unless a file has the arrays of a policy, and no others."""
    expected = {"layers", *_ARRAYS, *_NUMBERS, *_LISTS}
    expected |= {f"{kind}_{i}" for kind in ("weight", "bias") for i in range(_layers(content))}
    expected |= {"network", "commands"} & content.keys()
    expected |= set(GRU_ARRAYS) if kind(content) == RECURRENT_KIND else set()
    expected |= set(MIRROR_ARRAYS) if set(MIRROR_ARRAYS) & content.keys() else set()
    if content.keys() != expected:
        raise ValueError(f"{path} is damaged: {', '.join(sorted(expected ^ content.keys()))} missing or too much.")


def fields(content: dict[str, np.ndarray]) -> dict[str, Any]:
    """What the arrays of a file mean, by the names of `NumpyPolicy`. Raise ValueError for one that means nothing."""
    found: dict[str, Any] = {name: _array(content, name) for name in _ARRAYS}
    found |= {name: _number(content, name) for name in _NUMBERS}
    found |= {name: _texts(content, name) for name in _LISTS}
    layers = range(_layers(content))
    found["weights"] = tuple((_array(content, f"weight_{i}"), _array(content, f"bias_{i}")) for i in layers)
    if _number(content, "layers") != len(layers) or not layers:
        raise ValueError(f"layers is {content['layers']}, and there are weights of {len(layers)}")
    for name in ("std", "clip", "p_gain"):
        if not np.all(found[name] > 0):
            raise ValueError(f"{name} is to be above 0")
    for name in ("samples", "speed", "d_gain"):
        if not np.all(found[name] >= 0):
            raise ValueError(f"{name} is to be at least 0")
    if "commands" in content:
        found["commands"] = _array(content, "commands")
    if GRU_ARRAYS[0] in content:
        found["gru"] = Gru(*(_array(content, name) for name in GRU_ARRAYS))
    if MIRROR_ARRAYS[0] in content:
        found["mirror"] = Mirror(*(_integers(content, name) for name in MIRROR_ARRAYS))
    return found


def _layers(content: Mapping[str, np.ndarray]) -> int:
    """Layers that a file has weights of."""
    return sum(name.startswith("weight_") for name in content)


def _array(content: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    """The array of that name. Raise ValueError unless it holds finite numbers."""
    array = content[name]
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{name} does not hold numbers")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} holds NaN or infinity")
    return array


def _integers(content: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    """The list of that name. Raise ValueError unless it holds integers."""
    array = content[name]
    if array.ndim != 1 or array.dtype.kind != "i":
        raise ValueError(f"{name} is not a list of integers")
    return array


def _number(content: Mapping[str, np.ndarray], name: str) -> float:
    """The number of that name. Raise ValueError if it is none, or not finite."""
    array = _array(content, name)
    if array.ndim:
        raise ValueError(f"{name} has shape {array.shape} and is to be one number")
    return float(array)


def _texts(content: Mapping[str, np.ndarray], name: str) -> tuple[str, ...]:
    """The lines of text of that name. Raise ValueError if it holds anything else."""
    array = content[name]
    if array.ndim != 1 or array.dtype.kind != "U":
        raise ValueError(f"{name} is not a list of texts")
    return tuple(array.tolist())
