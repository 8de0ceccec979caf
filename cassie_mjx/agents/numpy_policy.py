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
from typing import Any

import numpy as np

from cassie_mjx.agents.policy_arrays import GRU_ARRAYS, MIRROR_ARRAYS, Mirror, check_names, fields, kind
from cassie_mjx.control.network import KIND, RECURRENT_KIND, Gru, Network, action, start
from cassie_mjx.files import archive
from cassie_mjx.robot import cassie

FORMAT = "cassie-mjx policy"


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
        check_names(found.arrays, Path(path))
        network = kind(found.arrays)
        if network not in (KIND, RECURRENT_KIND):
            raise ValueError(f"The network of {path} is a {network}; this version runs a {KIND} or a {RECURRENT_KIND}.")
        try:
            policy = cls(**fields(found.arrays), provenance=found.provenance)
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
