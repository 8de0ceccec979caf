"""A saved policy that runs on NumPy alone, and the file that it comes from: one .npz, nothing in it pickled.

The file holds everything between a state of the robot and the PD targets: weights, input statistics, reference motion,
joint names, gains, the layout of the observation and, for a policy that learned one step, its mirror. `network` says
what the weights are of; a recurrent one has those of its GRU besides.
"""

import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cassie_mjx.control.network import KIND, RECURRENT_KIND, Gru, Network, action, start
from cassie_mjx.files import archive
from cassie_mjx.robot import cassie

FORMAT = "cassie-mjx policy"

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
    """[80], the reflection of an observation."""
    action: np.ndarray
    """[10], the reflection of an action."""
    sides: np.ndarray
    """[2], where an observation has the reference's hip pitch angles, left and right, counted from 1. In the second
    step the left one is less than the right one."""

    def second_step(self, observation: np.ndarray) -> np.ndarray:
        """Which observations [..., 80] are of the second step, [..., 1], bool."""
        left, right = self.sides - 1
        return (observation[..., left] < observation[..., right])[..., None]


GRU_ARRAYS = tuple(f"gru_{name}" for name in Gru._fields)
"""Arrays that the file of a recurrent policy has besides."""
MIRROR_ARRAYS = tuple(f"mirror_{name}" for name in Mirror._fields)
"""Arrays that the file of a policy with a mirror has besides."""


@dataclass(frozen=True)
class NumpyPolicy:
    """A saved policy: `policy(observation)` is its deterministic action. Make one with `NumpyPolicy.load(path)`.

    A recurrent one remembers: begin with `policy.start(robots)`, and `policy.step(observation, hidden)` from then on.
    Every 32 ms, hold the PD targets `reference_qpos[(phase + 1) % N, active joints] + action`.
    """

    weights: tuple[tuple[np.ndarray, np.ndarray], ...]
    """(W [inputs, outputs], b [outputs]) of each layer, float32; ReLU between them, tanh at the end."""
    mean: np.ndarray
    """[80], subtracted from an observation."""
    std: np.ndarray
    """[80], which the difference is divided by."""
    clip: float
    """Bound on the result, either way."""
    samples: float
    """Observations behind mean and std."""
    speed: float
    """Factor by which the recorded reference motion was stretched along x; already in the arrays below."""
    reference_qpos: np.ndarray
    """[N, 35], the stride in MuJoCo's order, a sample every 32 ms: m, unit quaternions w x y z, rad."""
    reference_qvel: np.ndarray
    """[N, 32], its velocities: m/s, rad/s."""
    reference_stride_length: float
    """What pelvis x gains in a stride, m."""
    joints: tuple[str, ...]
    """Names of the ten active joints, in the order of the action."""
    p_gain: np.ndarray
    """[10], N·m/rad."""
    d_gain: np.ndarray
    """[10], N·m·s/rad."""
    observation: tuple[str, ...]
    """A line for each group of the observation: slice, content, unit."""
    provenance: Mapping[str, Any]
    """Where it came from: command, commit, versions, returns."""
    mirror: Mirror | None = None
    """How it takes the second step, if it learned the first alone; mean and std are those of reflected observations."""
    commands: np.ndarray | None = None
    """[4, 2], least and greatest forward velocity, lateral velocity (m/s, left positive), yaw rate (rad/s, left
    positive) and standing (0 or 1) that it learned to follow; [3, 2] of a file from before robots stood; None of one
    that is older than this entry."""
    gru: Gru | None = None
    """What a recurrent policy has before its weights, float32."""

    @property
    def network(self) -> Network:
        """The actor, as `control.network` runs it."""
        return Network(self.mean, self.std, self.clip, self.weights, self.gru)

    @property
    def kind(self) -> str:
        """What kind of network it has."""
        return KIND if self.gru is None else RECURRENT_KIND

    def start(self, robots: int) -> np.ndarray:
        """What it carries of robots that begin to walk, [robots, N]; N is 0 unless it is recurrent."""
        return start(self.network, robots)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the residuals on the reference angles of the active joints, rad, [10] or [B, 10].

        Args:
          observation: [O] or [B, O], as `self.observation` describes it.

        Raises:
          ValueError: another number of inputs, or the policy is recurrent.
        """
        if self.gru is not None:
            raise ValueError("The policy is recurrent; call policy.step(observation, hidden), first with policy.start.")
        return self.step(observation, np.zeros((*np.shape(observation)[:-1], 0)))[0]

    def step(self, observation: np.ndarray, hidden: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the residuals as a call does, and what to give the next step as `hidden`.

        Args:
          observation: [O] or [B, O], as `self.observation` describes it.
          hidden: [N] or [B, N], of `start` or the last step.

        Raises:
          ValueError: another number of inputs, or `hidden` of another shape.
        """
        x = np.asarray(observation, np.float32)
        if x.shape[-1:] != self.mean.shape:
            raise ValueError(
                f"An observation of shape {x.shape} was given; this policy takes {len(self.mean)} numbers."
            )
        carried = (*x.shape[:-1], self.start(1).shape[1])
        if np.shape(hidden) != carried:
            raise ValueError(f"hidden of shape {np.shape(hidden)} was given; this observation takes {carried}.")
        if self.mirror is None:
            return action(self.network, x, hidden)
        second = self.mirror.second_step(x)
        residual, hidden = action(self.network, np.where(second, _reflected(x, self.mirror.observation), x), hidden)
        return np.where(second, _reflected(residual, self.mirror.action), residual), hidden

    @classmethod
    def load(cls, path: str | Path) -> "NumpyPolicy":
        """Read a policy file; warn of one from before files had a digest.

        Raises:
          ValueError: the file is missing, damaged, of another format, holds a number that is not finite, or its parts
            do not fit together.
        """
        found = archive.read(Path(path), FORMAT)
        _check_names(found.arrays, Path(path))
        network = _kind(found.arrays)
        if network not in (KIND, RECURRENT_KIND):
            raise ValueError(f"The network of {path} is a {network}; this version runs a {KIND} or a {RECURRENT_KIND}.")
        try:
            policy = cls(**_fields(found.arrays), provenance=found.provenance)
        except ValueError as error:
            raise ValueError(f"{path} is damaged: a part of it is not of its kind ({error}).") from error
        _check_fit(policy, Path(path))
        if not found.has_digest:
            warnings.warn(
                f"{path} is of version 1 of its format, whose damage can go unnoticed; "
                f"python -m cassie_mjx.export run={path} out=NEW.npz writes it anew, with its SHA-256.",
                stacklevel=2,
            )
        return policy


def _reflected(values: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Values [..., n] as in the mirror that `places` [n] describe."""
    return values[..., abs(places).astype(int) - 1] * np.sign(places).astype(values.dtype)


def _kind(content: Mapping[str, np.ndarray]) -> str:
    """What a file says that its network is."""
    return str(content.get("network", _FIRST_KIND))


def _check_names(content: Mapping[str, np.ndarray], path: Path) -> None:
    """Raise ValueError unless a file has the arrays of a policy, and no others."""
    expected = {"layers", *_ARRAYS, *_NUMBERS, *_LISTS}
    expected |= {f"{kind}_{i}" for kind in ("weight", "bias") for i in range(_layers(content))}
    expected |= {"network", "commands"} & content.keys()
    expected |= set(GRU_ARRAYS) if _kind(content) == RECURRENT_KIND else set()
    expected |= set(MIRROR_ARRAYS) if set(MIRROR_ARRAYS) & content.keys() else set()
    if content.keys() != expected:
        raise ValueError(f"{path} is damaged: {', '.join(sorted(expected ^ content.keys()))} missing or too much.")


def _fields(content: dict[str, np.ndarray]) -> dict[str, Any]:
    """What the arrays of a file mean, by the names of `NumpyPolicy`. Raise ValueError for one that means nothing."""
    fields: dict[str, Any] = {name: _array(content, name) for name in _ARRAYS}
    fields |= {name: _number(content, name) for name in _NUMBERS}
    fields |= {name: _texts(content, name) for name in _LISTS}
    layers = range(_layers(content))
    fields["weights"] = tuple((_array(content, f"weight_{i}"), _array(content, f"bias_{i}")) for i in layers)
    if _number(content, "layers") != len(layers) or not layers:
        raise ValueError(f"layers is {content['layers']}, and there are weights of {len(layers)}")
    for name in ("std", "clip", "p_gain"):
        if not np.all(fields[name] > 0):
            raise ValueError(f"{name} is to be above 0")
    for name in ("samples", "speed", "d_gain"):
        if not np.all(fields[name] >= 0):
            raise ValueError(f"{name} is to be at least 0")
    if "commands" in content:
        fields["commands"] = _array(content, "commands")
    if GRU_ARRAYS[0] in content:
        fields["gru"] = Gru(*(_array(content, name) for name in GRU_ARRAYS))
    if MIRROR_ARRAYS[0] in content:
        fields["mirror"] = Mirror(*(_integers(content, name) for name in MIRROR_ARRAYS))
    return fields


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


def _check_fit(policy: NumpyPolicy, path: Path) -> None:
    """Raise ValueError unless the parts of a policy have sizes that fit together, and its reference samples."""
    last = re.match(r"[0-9]+:([0-9]{1,9}) ", policy.observation[-1]) if policy.observation else None
    widths = [int(last[1]) if last else 0, *(bias.size for _, bias in policy.weights)]
    inputs, outputs = widths[0], widths[-1]
    remembered = policy.gru.recurrent_bias.size if policy.gru else 0
    if policy.gru:
        widths[0] = remembered
    gru_shapes = (inputs, 3 * remembered), (remembered, 3 * remembered), (3 * remembered,), (remembered,)
    layers = list(zip(policy.weights, pairwise(widths), strict=True))
    known = 3 if policy.commands is not None and len(policy.commands) == 3 else 4
    for name, array, shape in (
        ("mean", policy.mean, (inputs,)),
        ("std", policy.std, (inputs,)),
        *(zip(GRU_ARRAYS, policy.gru, gru_shapes, strict=True) if policy.gru else ()),
        *((f"weight_{i}", weight, shape) for i, ((weight, _), shape) in enumerate(layers)),
        *((f"bias_{i}", bias, shape[1:]) for i, ((_, bias), shape) in enumerate(layers)),
        *((("commands", policy.commands, (known, 2)),) if policy.commands is not None else ()),
        ("p_gain", policy.p_gain, (outputs,)),
        ("d_gain", policy.d_gain, (outputs,)),
    ):
        if array.shape != shape:
            raise ValueError(f"{path} does not fit together: {name} has shape {array.shape} instead of {shape}.")
    if policy.mirror:
        for name, places, size in zip(MIRROR_ARRAYS, policy.mirror, (inputs, outputs), strict=False):
            if sorted(abs(places).tolist()) != list(range(1, 1 + size)):
                raise ValueError(f"{path} does not fit together: {name} does not have each of 1 to {size} once.")
        sides = policy.mirror.sides
        if sides.shape != (2,) or sides[0] == sides[1] or not ((sides >= 1) & (sides <= inputs)).all():
            raise ValueError(f"{path} does not fit together: mirror_sides is not two of 1 to {inputs}.")
    qpos, qvel = policy.reference_qpos.shape, policy.reference_qvel.shape
    if (qpos[1:], qvel[1:]) != ((cassie.NQ,), (cassie.NV,)) or not qpos[0] == qvel[0] > 0:
        raise ValueError(
            f"{path} does not fit together: reference_qpos has shape {qpos} and reference_qvel {qvel} instead of a row "
            f"of {cassie.NQ} and one of {cassie.NV} for every sample."
        )
    if outputs != len(policy.joints):
        raise ValueError(f"{path} does not fit together: {outputs} outputs for {len(policy.joints)} joints.")
