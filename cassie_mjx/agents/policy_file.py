"""A policy as one .npz file that runs on NumPy alone: `python -m cassie_mjx.export run=runs/1x-seed0 out=policy.npz`.

`cassie_mjx.agents.numpy_policy` reads and runs it; here it is written, and handed to a learner.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from cassie_mjx.agents.numpy_policy import FORMAT, NumpyPolicy
from cassie_mjx.agents.policy_arrays import GRU_ARRAYS, MIRROR_ARRAYS
from cassie_mjx.agents.saved_law import control_law, file_mirror
from cassie_mjx.control.law import ControlLaw
from cassie_mjx.control.network import KIND, RECURRENT_KIND
from cassie_mjx.files import archive
from cassie_mjx.motion.reference import ReferenceMotion, mean_speed
from cassie_mjx.ppo import networks, normalizer
from cassie_mjx.ppo.types import Normalizer, Policy
from cassie_mjx.robot import cassie

FULL_LAW = ControlLaw()
"""The paper's 80-D state, and both steps learned."""


def save_policy(
    path: Path,
    policy: Policy,
    motion: ReferenceMotion,
    speed: float,
    kd_scale: float,
    provenance: Mapping[str, Any],
    law: ControlLaw = FULL_LAW,
    commands: np.ndarray | None = None,
) -> None:
    """Write a policy file with its digest, whole or not at all.

    Args:
      path: ends in .npz.
      policy: actor and input statistics.
      motion: what the policy was trained to follow, stretched already.
      speed: by which factor.
      kd_scale: factor on the D gains of the PD law that holds its targets.
      provenance: anything JSON can hold.
      law: what it observes, and what its actions mean.
      commands: least and greatest of each component of the commands that it learned to follow, [4, 2]; the speed of
        the motion alone unless given.

    Raises:
      OSError: it cannot be written; a file of that name is as it was.
    """
    arrays = _network_arrays(policy) | _motion_arrays(motion) | _law_arrays(law)
    if commands is None:
        own = float(mean_speed(motion))
        commands = np.array([[own, own], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    asked = {"speed": speed, "commands": commands, "d_gain": kd_scale * cassie.D_GAIN}
    archive.write(path, FORMAT, arrays | asked, provenance)


def _network_arrays(policy: Policy) -> dict[str, Any]:
    """The actor and its input statistics, as a policy file has them."""
    layers, statistics = networks.layers(policy.actor), policy.normalizer
    gru = networks.gru(policy.actor)
    return {
        **(dict(zip(GRU_ARRAYS, gru, strict=True)) if gru else {}),
        **{f"weight_{i}": weight for i, (weight, _) in enumerate(layers)},
        **{f"bias_{i}": bias for i, (_, bias) in enumerate(layers)},
        "layers": len(layers),
        "network": KIND if gru is None else RECURRENT_KIND,
        "mean": statistics.mean,
        "std": normalizer.std(statistics),
        "clip": normalizer.CLIP,
        "samples": statistics.samples,
    }


def _motion_arrays(motion: ReferenceMotion) -> dict[str, Any]:
    """The motion imitated, as a policy file has it."""
    return {
        "reference_qpos": motion.qpos,
        "reference_qvel": motion.qvel,
        "reference_stride_length": motion.stride_length,
    }


def _law_arrays(law: ControlLaw) -> dict[str, Any]:
    """What is observed, what is driven and how stiffly, as a policy file has it."""
    mirror = dict(zip(MIRROR_ARRAYS, file_mirror(law), strict=True)) if law.symmetric else {}
    return {
        "joints": cassie.ACTUATORS,
        "p_gain": cassie.P_GAIN,
        "observation": law.observation.describe(),
        **mirror,
    }


def learner_policy(saved: NumpyPolicy) -> Policy:
    """The same policy for `ppo.networks`, without noise: to be evaluated on an accelerator, or trained further.

    Of one with a mirror it is what it does in the first step; `control_law` makes that whole.

    Raises:
      ValueError: it was trained on another layout of the observation, with another bound on its inputs or another
        mirror, or for another robot, than this version's.
    """
    control_law(saved)
    if saved.clip != normalizer.CLIP:
        raise ValueError(
            f"The policy bounds its inputs at {saved.clip:g} standard deviations, this version at {normalizer.CLIP:g}; "
            "use the version it was trained with, named in its provenance."
        )
    if saved.joints != cassie.ACTUATORS:
        raise ValueError(
            "The policy drives joints that this version's robot has not, or in another order; use the version it was "
            "trained with, named in its provenance."
        )
    names = [*(f"hidden_{i}" for i in range(len(saved.weights) - 1)), "output"]
    layers = [{"kernel": jnp.asarray(weight), "bias": jnp.asarray(bias)} for weight, bias in saved.weights]
    actor = dict(zip(names, layers, strict=True))
    if saved.gru:
        actor[networks.GRU] = {name: jnp.asarray(array) for name, array in saved.gru._asdict().items()}
    squares = jnp.asarray(np.square(saved.std) * saved.samples)
    statistics = Normalizer(jnp.asarray(saved.samples, jnp.float32), jnp.asarray(saved.mean), squares)
    return Policy(statistics, actor, std=jnp.zeros(()))
