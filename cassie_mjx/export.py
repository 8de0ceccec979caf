"""A policy as one .npz file that runs on NumPy alone: `python -m cassie_mjx.export run=runs/1x-seed0 out=policy.npz`.

The file holds everything between a state of the robot and the PD targets: weights, input statistics, reference motion,
joint names, gains and the layout of the observation. Nothing in it is pickled. Running it takes NumPy alone.
"""

import json
import os
import re
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from cassie_mjx.ppo.types import Policy
    from cassie_mjx.reference import ReferenceMotion

FOLDER = Path(__file__).parent / "policies"
FORMAT = "cassie-mjx policy"
VERSION = 1
CHOICES = ("best", "last")

_ARRAYS = ("mean", "std", "reference_qpos", "reference_qvel", "p_gain", "d_gain")
_NUMBERS = ("clip", "samples", "speed", "reference_stride_length")
_LISTS = ("joints", "observation")
_MIRROR = ("mirror_observation", "mirror_action", "mirror_sides")
"""What the file of a policy that learned one step has besides, in the order of `Mirror`."""

# What NumPy and zipfile raise on content that is none of theirs.
_UNREADABLE = (OSError, EOFError, ValueError, TypeError, KeyError, RuntimeError, zipfile.BadZipFile, zlib.error)


class Mirror(NamedTuple):
    """How a policy that learned one of the stride's two steps takes the other: it sees and acts as in a mirror.

    Reflections are lists of places, counted from 1: at i the image has what was at place |i|, with the sign of place i.
    """

    observation: np.ndarray
    """[80], the reflection of an observation."""
    action: np.ndarray
    """[10], the reflection of an action."""
    sides: np.ndarray
    """[2], places of the reference's hip pitch, left and right, in an observation; in the second step left is less."""

    def second_step(self, observation: np.ndarray) -> np.ndarray:
        """Which observations [..., 80] are of the second step, [..., 1], bool."""
        left, right = self.sides - 1
        return (observation[..., left] < observation[..., right])[..., None]


@dataclass(frozen=True)
class NumpyPolicy:
    """A saved policy: `policy(observation)` is its deterministic action. Make one with `NumpyPolicy.load(path)`.

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
    """How it takes the second step, if it learned the first alone."""

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the residuals on the reference angles of the active joints, rad, [10] or [B, 10].

        Args:
          observation: [80] or [B, 80], as `self.observation` describes it.

        Raises:
          ValueError: another number of inputs.
        """
        x = np.asarray(observation, np.float32)
        if x.shape[-1:] != self.mean.shape:
            raise ValueError(
                f"An observation of shape {x.shape} was given; this policy takes {len(self.mean)} numbers."
            )
        if self.mirror is None:
            return self._mode(x)
        second = self.mirror.second_step(x)
        action = self._mode(np.where(second, _reflected(x, self.mirror.observation), x))
        return np.where(second, _reflected(action, self.mirror.action), action)

    def _mode(self, x: np.ndarray) -> np.ndarray:
        x = ((x - self.mean) / self.std).clip(-self.clip, self.clip)
        *hidden, (output, output_bias) = self.weights
        for weight, bias in hidden:
            x = np.maximum(x @ weight + bias, 0)
        return np.tanh(x @ output + output_bias)

    @classmethod
    def load(cls, path: str | Path) -> "NumpyPolicy":
        """Read a policy file.

        Raises:
          ValueError: the file is missing, damaged, of another format, holds a number that is not finite, or its parts
            do not fit together.
        """
        content = _read(Path(path))
        try:
            policy = cls(**_fields(content))
        except ValueError as error:
            raise ValueError(f"{path} is damaged: a part of it is not of its kind ({error}).") from error
        _check_fit(policy, Path(path))
        return policy


def _reflected(values: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Values [..., n] as in the mirror that `places` [n] describe."""
    return values[..., abs(places) - 1] * np.sign(places).astype(values.dtype)


def shipped_policies() -> dict[str, Path]:
    """Files of the trained policies that come with the package, by name."""
    return {path.stem: path for path in sorted(FOLDER.glob("*.npz"), key=lambda path: path.stem)}


def find(name: str) -> Path | None:
    """The policy we ship as `name`, the file `name`, or the best policy of the run in that directory; None if none.

    Raises:
      ValueError: there is such a file or run, and we ship a policy of the same name.
    """
    path = Path(name) / "best.npz" if Path(name).is_dir() else Path(name)
    shipped, local = shipped_policies().get(name), path if path.is_file() else None
    if shipped and local:
        raise ValueError(
            f"{name} comes with the package and is here as well, as {local}; write ./{name} for the one here, or "
            f"{shipped} for the other."
        )
    return shipped or local


def save_policy(
    path: Path,
    policy: "Policy",
    motion: "ReferenceMotion",
    speed: float,
    damping: float,
    provenance: Mapping[str, Any],
    symmetric: bool = False,
) -> None:
    """Write a policy file, whole or not at all.

    Args:
      path: ends in .npz.
      policy: actor and input statistics.
      motion: what the policy was trained to follow, stretched already.
      speed: by which factor.
      damping: factor on the D gains of the PD law that holds its targets.
      provenance: anything JSON can hold.
      symmetric: whether it learned one of the stride's two steps alone.

    Raises:
      OSError: it cannot be written; a file of that name is as it was.
    """
    from cassie_mjx import robot
    from cassie_mjx.envs import observation
    from cassie_mjx.ppo import networks, normalizer

    layers = networks.layers(policy.actor)
    arrays: dict[str, Any] = {f"weight_{i}": weight for i, (weight, _) in enumerate(layers)}
    arrays |= {f"bias_{i}": bias for i, (_, bias) in enumerate(layers)}
    arrays |= {
        "format": FORMAT,
        "version": VERSION,
        "provenance": json.dumps(dict(provenance)),
        "speed": speed,
        "layers": len(layers),
        "mean": policy.normalizer.mean,
        "std": normalizer.std(policy.normalizer),
        "clip": normalizer.CLIP,
        "samples": policy.normalizer.samples,
        "reference_qpos": motion.qpos,
        "reference_qvel": motion.qvel,
        "reference_stride_length": motion.stride_length,
        "joints": robot.ACTUATORS,
        "p_gain": robot.P_GAIN,
        "d_gain": damping * robot.D_GAIN,
        "observation": observation.describe(),
    }
    if symmetric:
        arrays |= dict(zip(_MIRROR, _mirror(), strict=True))
    partial = path.with_name(path.name + ".partial")
    try:
        with partial.open("wb") as file:
            np.savez(file, **arrays)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise OSError(f"The policy {path} could not be written ({error.strerror or error}).") from error


def _mirror() -> Mirror:
    """The mirror of this version's observations and actions."""
    from cassie_mjx import robot
    from cassie_mjx.envs import observation

    return Mirror(observation.MIRROR, robot.mirror_active(1 + np.arange(robot.NU)), 1 + observation.REFERENCE_HIP_PITCH)


def learner_policy(saved: NumpyPolicy) -> "Policy":
    """The same policy for `ppo.networks`, without noise: to be evaluated on an accelerator, or trained further.

    Raises:
      ValueError: it was trained on another layout of the observation, with another bound on its inputs, or for another
        robot, than this version's.
    """
    import jax.numpy as jnp

    from cassie_mjx import robot
    from cassie_mjx.envs import observation
    from cassie_mjx.ppo.normalizer import CLIP
    from cassie_mjx.ppo.types import Normalizer, Policy

    differing = [line for line in saved.observation if line not in observation.describe()]
    if differing or len(saved.observation) != len(observation.describe()):
        raise ValueError(
            f"The policy observes {'; '.join(differing) or len(saved.observation)}, which this version's observation "
            "has not; use the version it was trained with, named in its provenance."
        )
    if saved.clip != CLIP:
        raise ValueError(
            f"The policy bounds its inputs at {saved.clip:g} standard deviations, this version at {CLIP:g}; use the "
            "version it was trained with, named in its provenance."
        )
    stride = saved.reference_qpos.shape[1:], saved.reference_qvel.shape[1:]
    if saved.mirror and not all(map(np.array_equal, saved.mirror, _mirror())):
        raise ValueError(
            "The policy's mirror is not this version's; use the version it was trained with, named in its provenance."
        )
    if saved.joints != robot.ACTUATORS or stride != ((robot.NQ,), (robot.NV,)):
        raise ValueError(
            "The policy drives joints or imitates a motion that this version's robot has not; use the version it was "
            "trained with, named in its provenance."
        )
    names = [*(f"hidden_{i}" for i in range(len(saved.weights) - 1)), "output"]
    layers = [{"kernel": jnp.asarray(weight), "bias": jnp.asarray(bias)} for weight, bias in saved.weights]
    squares = jnp.asarray(np.square(saved.std) * saved.samples)
    normalizer = Normalizer(jnp.asarray(saved.samples, jnp.float32), jnp.asarray(saved.mean), squares)
    return Policy(normalizer, dict(zip(names, layers, strict=True)), std=jnp.zeros(()))


def _read(path: Path) -> dict[str, np.ndarray]:
    if not path.is_file():
        raise ValueError(f"There is no policy file {path}.")
    try:
        with np.load(path, allow_pickle=False) as archive:
            content = {name: np.asarray(archive[name]) for name in archive.files}
    except _UNREADABLE as error:
        raise ValueError(f"{path} is damaged or no policy file: {error}.") from error
    if str(content.get("format")) != FORMAT:
        raise ValueError(f"{path} is not a {FORMAT}; make one with python -m cassie_mjx.export.")
    if str(content.get("version")) != str(VERSION):
        raise ValueError(f"{path} has version {content.get('version')}; this program reads version {VERSION}.")
    expected = {"format", "version", "provenance", "layers", *_ARRAYS, *_NUMBERS, *_LISTS}
    expected |= {f"{kind}_{i}" for kind in ("weight", "bias") for i in range(_layers(content))}
    expected |= set(_MIRROR) if _MIRROR[0] in content else set()
    if content.keys() != expected:
        raise ValueError(f"{path} is damaged: {', '.join(sorted(expected ^ content.keys()))} missing or too much.")
    return content


def _fields(content: dict[str, np.ndarray]) -> dict[str, Any]:
    """What the arrays of a file mean, by the names of `NumpyPolicy`. Raise ValueError for one that means nothing."""
    fields: dict[str, Any] = {name: _array(content, name) for name in _ARRAYS}
    fields |= {name: _number(content, name) for name in _NUMBERS}
    fields |= {name: _texts(content, name) for name in _LISTS}
    layers = range(_layers(content))
    fields["weights"] = tuple((_array(content, f"weight_{i}"), _array(content, f"bias_{i}")) for i in layers)
    if _number(content, "layers") != len(layers) or not layers:
        raise ValueError(f"layers is {content['layers']}, and there are weights of {len(layers)}")
    if not (fields["std"] > 0).all():
        raise ValueError("std is to be above 0")
    fields["provenance"] = json.loads(str(content["provenance"]))
    if _MIRROR[0] in content:
        fields["mirror"] = Mirror(*(_array(content, name) for name in _MIRROR))
    if not isinstance(fields["provenance"], dict):
        raise ValueError("provenance has no names")
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
    last = re.match(r"\d+:(\d+) ", policy.observation[-1]) if policy.observation else None
    widths = [int(last[1]) if last else 0, *(bias.size for _, bias in policy.weights)]
    inputs, outputs = widths[0], widths[-1]
    layers = list(zip(policy.weights, pairwise(widths), strict=True))
    for name, array, shape in (
        ("mean", policy.mean, (inputs,)),
        ("std", policy.std, (inputs,)),
        *((f"weight_{i}", weight, shape) for i, ((weight, _), shape) in enumerate(layers)),
        *((f"bias_{i}", bias, shape[1:]) for i, ((_, bias), shape) in enumerate(layers)),
        ("p_gain", policy.p_gain, (outputs,)),
        ("d_gain", policy.d_gain, (outputs,)),
    ):
        if array.shape != shape:
            raise ValueError(f"{path} does not fit together: {name} has shape {array.shape} instead of {shape}.")
    mirror = policy.mirror or ()
    for name, places, size, among in zip(
        _MIRROR, mirror, (inputs, outputs, 2), (inputs, outputs, inputs), strict=False
    ):
        if places.shape != (size,) or not set(abs(places)) <= set(range(1, 1 + among)):
            raise ValueError(f"{path} does not fit together: {name} is not {size} of the places 1 to {among}.")
    qpos, qvel = policy.reference_qpos.shape, policy.reference_qvel.shape
    if not len(qpos) == len(qvel) == 2 or qpos[0] != qvel[0] or qpos[0] == 0:
        raise ValueError(
            f"{path} does not fit together: reference_qpos has shape {qpos} and reference_qvel {qvel} instead of a row "
            "of each for every sample."
        )
    if outputs != len(policy.joints):
        raise ValueError(f"{path} does not fit together: {outputs} outputs for {len(policy.joints)} joints.")


@dataclass(frozen=True)
class ExportConfig:
    """What to export."""

    run: str
    """Directory of a training run."""
    out: str
    """File to write, .npz."""
    which: str = "best"
    """"best": of the highest return by the reward it learned from, under disturbances the last; "last": the last."""


def main(config: ExportConfig) -> None:
    """Copy a run's policy to a file of its own, checked."""
    from cassie_mjx import cli

    if config.which not in CHOICES:
        raise ValueError(f"which={config.which!r} is not known; choose one of {', '.join(CHOICES)}.")
    out, source = cli.check_writable(config.out), Path(config.run) / f"{config.which}.npz"
    policy = NumpyPolicy.load(source)
    partial = out.with_name(out.name + ".partial")
    partial.write_bytes(source.read_bytes())
    partial.replace(out)
    returns = {name: value for name, value in policy.provenance.items() if name.startswith("return_")}
    print(f"{config.out}: " + ", ".join(f"{name} {value:.1f}" for name, value in returns.items()))


if __name__ == "__main__":
    from cassie_mjx import cli

    cli.run(main, ExportConfig)
