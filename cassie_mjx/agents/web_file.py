"""A policy as plain arrays for the page in a browser: `python -m cassie_mjx.export policy=joystick web=FOLDER`.

One JSON file has all that `page/src` needs beside the MJCF: the network, the reference motion, the gains, and the
figures of robot, command and ground that the rest of this package keeps in one place each.
"""

import base64
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cassie_mjx.agents.numpy_policy import NumpyPolicy
from cassie_mjx.agents.saved_law import control_law
from cassie_mjx.control import command, path
from cassie_mjx.control.law import ControlLaw
from cassie_mjx.control.observation import Seen
from cassie_mjx.files.atomic import write_text
from cassie_mjx.motion.reference import QUATERNIONS, RAMP_PER_S, ReferenceMotion, mean_speed
from cassie_mjx.motion.schedule import LIMITS
from cassie_mjx.robot import cassie, ground

FORMAT, VERSION = "cassie-mjx policy for the web", 2
"""The page reads this version alone (`page/src/control/policy_file.js`)."""

_SIZES = (cassie.NQ, cassie.NV, cassie.NQ, cassie.NV)
"""Of what an observation is gathered from: qpos and qvel of the robot, then of the reference."""


def save_web(file: Path, policy: NumpyPolicy, name: str) -> None:
    """Write a policy for the page, whole or not at all.

    Args:
      file: ends in .json.
      policy: what to write.
      name: what the page calls it.

    Raises:
      ValueError: the page has no code for its network or for what it observes.
      OSError: it cannot be written.
    """
    write_text(file, json.dumps(content(policy, name)) + "\n")


def content(policy: NumpyPolicy, name: str) -> dict[str, Any]:
    """What the file says, as JSON has it. Raises ValueError as `save_web` does."""
    if policy.kind != "perceptron, ReLU":
        raise ValueError(f"The page runs a perceptron, ReLU; teach `page/src/control/law.js` a {policy.kind}.")
    law = control_law(policy)
    motion = ReferenceMotion(policy.reference_qpos, policy.reference_qvel, np.asarray(policy.reference_stride_length))
    permutation, sign = law.observation.mirror
    return {
        "format": FORMAT,
        "version": VERSION,
        "name": name,
        "commands": None if policy.commands is None else policy.commands.tolist(),
        "network": {
            "mean": _packed(policy.mean),
            "std": _packed(policy.std),
            "clip": policy.clip,
            "layers": [[_packed(weight), _packed(bias)] for weight, bias in policy.weights],
        },
        "observation": {
            **{name: places.tolist() for name, places in sources(law)._asdict().items()},
            "mirror": {"permutation": permutation.tolist(), "sign": sign.tolist()},
        },
        "symmetric": law.symmetric,
        "reference": {
            "qpos": policy.reference_qpos.tolist(),
            "qvel": policy.reference_qvel.tolist(),
            "stride_length_m": policy.reference_stride_length,
        },
        "p_gain": policy.p_gain.tolist(),
        "d_gain": policy.d_gain.tolist(),
        "robot": _robot(policy.joints),
        "steering": _steering(motion),
        "ground": _ground(),
    }


class Sources(NamedTuple):
    """Where each number of an observation comes from."""

    place: np.ndarray
    """[O], of qpos, qvel, and those of the reference, side by side."""
    age: np.ndarray
    """[O], control steps: how long ago it was seen."""


def sources(law: ControlLaw) -> Sources:
    """Where the numbers of an observation come from.

    Raises:
      ValueError: an observation is more than a choice of numbers of the state and of the reference, now and before.
    """
    count, frames = sum(_SIZES), 1 + law.init(_seen(np.zeros(sum(_SIZES)))).shape[1]
    numbers = 1 + np.arange(frames * count).reshape(frames, count)
    places = np.rint(_observed(law, numbers)).astype(int) - 1
    other = np.random.default_rng(0).uniform(0.1, 1.0, numbers.shape)
    if not (np.isin(places, numbers - 1).all() and np.array_equal(_observed(law, other), other.ravel()[places])):
        raise ValueError(
            "The page shows a policy numbers of the state and of the reference alone, and this one observes more; "
            "teach `page/src/control/law.js` its terms."
        )
    return Sources(place=places % count, age=places // count)


def _observed(law: ControlLaw, numbers: np.ndarray) -> np.ndarray:
    """The observation [O] of one robot; its states and references are `numbers` [H, N], side by side, newest first."""
    *before, now = (_seen(frame) for frame in numbers[::-1])
    carry = law.init(before[0] if before else now)
    for seen in before:
        _, carry = law.observation.update(carry, seen)
    return law.observation.update(carry, now)[0][0]


def _seen(numbers: np.ndarray) -> Seen:
    """What one robot sees whose state and reference are these numbers, [N], side by side."""
    qpos, qvel, reference_qpos, reference_qvel = np.split(numbers[None].astype(float), np.cumsum(_SIZES)[:-1], axis=1)
    return Seen(qpos, qvel, reference_qpos, reference_qvel)


def _robot(joints: Sequence[str]) -> dict[str, Any]:
    """Where a state has what, the motors of `joints`, and when a robot has fallen."""
    mirrored = cassie.mirror_active(1 + np.arange(cassie.NU))
    return {
        "control_period_s": cassie.CONTROL_PERIOD_S,
        "joints": list(joints),
        "active_qpos": cassie.qpos_index(*joints).tolist(),
        "active_qvel": cassie.qvel_index(*joints).tolist(),
        "hip_pitch_qpos": cassie.HIP_PITCH_QPOS.tolist(),
        "quaternions": QUATERNIONS.tolist(),
        "standing_qpos": cassie.STANDING_QPOS.tolist(),
        "mirror": {"permutation": (abs(mirrored) - 1).tolist(), "sign": np.sign(mirrored).tolist()},
        "torque_limit": cassie.TORQUE_LIMIT.tolist(),
        "gear": cassie.GEAR.tolist(),
        "pelvis_body": cassie.PELVIS_BODY,
        "fall_m": [cassie.FALL_LOW_M, cassie.FALL_HIGH_M],
    }


def _steering(motion: ReferenceMotion) -> dict[str, Any]:
    """Limits and paces of commands (`control.command`, `control.path`)."""
    return {
        "limits": LIMITS.tolist(),
        "speeding": RAMP_PER_S * float(mean_speed(motion)),
        "braking": command.BRAKING,
        "lateral_pace": command.LATERAL_PACE,
        "yaw_pace": command.YAW_PACE,
        "stand_s": command.STAND_S,
        "step_out_mps": command.STEP_OUT_MPS,
        "sway_mps": command.SWAY_MPS,
        "leash_m": path.LEASH_M,
    }


def _ground() -> dict[str, Any]:
    """The figures of `robot.ground`."""
    return {
        "start_x_m": ground.START_X_M,
        "level_m": ground.LEVEL_M,
        "tread_m": ground.TREAD_M,
        "highest": ground.HIGHEST,
        "waves": ground.WAVES.tolist(),
    }


def _packed(array: np.ndarray) -> dict[str, Any]:
    """An array as its shape and its numbers, little-endian float32 in base64."""
    return {"shape": array.shape, "float32": base64.b64encode(array.astype("<f4").tobytes()).decode()}
