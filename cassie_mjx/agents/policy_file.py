"""A policy as one .npz file that runs on NumPy alone: `python -m cassie_mjx.export run=runs/1x-seed0 out=policy.npz`.

`cassie_mjx.numpy_policy` reads and runs it; here it is written, found, copied and handed to a learner.
"""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from cassie_mjx.agents.numpy_policy import FORMAT, MIRROR_ARRAYS, VERSION, Mirror, NumpyPolicy
from cassie_mjx.control import observation
from cassie_mjx.motion.reference import ReferenceMotion
from cassie_mjx.ppo import networks, normalizer
from cassie_mjx.ppo.types import Normalizer, Policy
from cassie_mjx.robot import cassie

FOLDER = Path(__file__).parent / "policies"


def shipped_policies() -> dict[str, Path]:
    """Files of the trained policies that come with the package, by name."""
    return {path.stem: path for path in sorted(FOLDER.glob("*.npz"), key=lambda path: path.stem)}


def policy_path(name: str) -> Path | None:
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
    policy: Policy,
    motion: ReferenceMotion,
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
        "joints": cassie.ACTUATORS,
        "p_gain": cassie.P_GAIN,
        "d_gain": damping * cassie.D_GAIN,
        "observation": observation.describe(),
    }
    if symmetric:
        arrays |= dict(zip(MIRROR_ARRAYS, _mirror(), strict=True))
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
    return Mirror(
        observation.MIRROR, cassie.mirror_active(1 + np.arange(cassie.NU)), 1 + observation.REFERENCE_HIP_PITCH
    )


def learner_policy(saved: NumpyPolicy) -> Policy:
    """The same policy for `ppo.networks`, without noise: to be evaluated on an accelerator, or trained further.

    Of one with a mirror it is what it does in the first step; `observation.symmetric` makes that whole.

    Raises:
      ValueError: it was trained on another layout of the observation, with another bound on its inputs or another
        mirror, or for another robot, than this version's.
    """
    differing = [line for line in saved.observation if line not in observation.describe()]
    if differing or len(saved.observation) != len(observation.describe()):
        raise ValueError(
            f"The policy observes {'; '.join(differing) or len(saved.observation)}, which this version's observation "
            "has not; use the version it was trained with, named in its provenance."
        )
    if saved.clip != normalizer.CLIP:
        raise ValueError(
            f"The policy bounds its inputs at {saved.clip:g} standard deviations, this version at {normalizer.CLIP:g}; "
            "use the version it was trained with, named in its provenance."
        )
    if saved.mirror and not all(map(np.array_equal, saved.mirror, _mirror())):
        raise ValueError(
            "The policy's mirror is not this version's; use the version it was trained with, named in its provenance."
        )
    stride = saved.reference_qpos.shape[1:], saved.reference_qvel.shape[1:]
    if saved.joints != cassie.ACTUATORS or stride != ((cassie.NQ,), (cassie.NV,)):
        raise ValueError(
            "The policy drives joints or imitates a motion that this version's robot has not; use the version it was "
            "trained with, named in its provenance."
        )
    names = [*(f"hidden_{i}" for i in range(len(saved.weights) - 1)), "output"]
    layers = [{"kernel": jnp.asarray(weight), "bias": jnp.asarray(bias)} for weight, bias in saved.weights]
    squares = jnp.asarray(np.square(saved.std) * saved.samples)
    statistics = Normalizer(jnp.asarray(saved.samples, jnp.float32), jnp.asarray(saved.mean), squares)
    return Policy(statistics, dict(zip(names, layers, strict=True)), std=jnp.zeros(()))
