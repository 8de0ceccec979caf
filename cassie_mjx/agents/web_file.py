"""A policy as plain arrays for the page in a browser: `python -m cassie_mjx.export policy=joystick web=FOLDER`.

One JSON file has all that `page/src` needs beside the MJCF: the network, the reference motion, the gains, and the
figures of robot, command and ground that the rest of this package keeps in one place each.
"""

import base64
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cassie_mjx.agents.numpy_policy import NumpyPolicy
from cassie_mjx.agents.saved_law import control_law
from cassie_mjx.control import command, path
from cassie_mjx.control.law import ControlLaw
from cassie_mjx.control.network import KIND
from cassie_mjx.control.observation import Seen
from cassie_mjx.files.atomic import write_text
from cassie_mjx.motion.reference import QUATERNIONS, RAMP_PER_S, ReferenceMotion, mean_speed
from cassie_mjx.motion.schedule import LIMITS
from cassie_mjx.robot import cassie, ground, leg
from cassie_mjx.robot.leg import pelvis_velocities

FORMAT, VERSION = "cassie-mjx policy for the web", 3
"""The page reads this version alone (`page/src/control/policy_file.js`)."""

_SIZES = (cassie.NQ, cassie.NV, cassie.NQ, cassie.NV)
"""Of qpos and qvel of the robot, then of the reference."""


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
    if KIND != "perceptron, ReLU":
        raise ValueError(f"The page runs a perceptron, ReLU; teach `page/src/control/network.js` a {KIND}.")
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
            "gru": None if policy.gru is None else {name: _packed(part) for name, part in policy.gru._asdict().items()},
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
    """[O], of qpos, qvel, those of the reference, and leg odometry (`robot.leg`), side by side."""
    age: np.ndarray
    """[O], control steps: how long ago it was seen."""


def sources(law: ControlLaw) -> Sources:
    """Where the numbers of an observation come from.

    Raises:
      ValueError: an observation is more than a choice of numbers of the state, of the reference and of leg odometry,
        now and before.
    """
    draw, frames = np.random.default_rng(0), 1 + law.init(_seen(np.zeros(sum(_SIZES)))).shape[1]
    once, again = (_shown(law, draw.uniform(0.1, 1.0, (frames, sum(_SIZES)))) for _ in range(2))
    found = np.array([np.append(np.flatnonzero(number == once.offered), -1)[0] for number in once.observed])
    if (found < 0).any() or not np.array_equal(again.observed, again.offered.ravel()[found]):
        raise ValueError(
            "The page shows a policy numbers of the state, of the reference and of leg odometry alone, and this one "
            "observes more; teach `page/src/control/law.js` its terms."
        )
    count = once.offered.shape[1]
    return Sources(place=found % count, age=found // count)


class _Shown(NamedTuple):
    """What one robot observes, and what that may be chosen from."""

    observed: np.ndarray
    """[O]."""
    offered: np.ndarray
    """[H, N], newest first."""


def _shown(law: ControlLaw, numbers: np.ndarray) -> _Shown:
    """Of a robot whose states and references are `numbers` [H, N], side by side, newest first."""
    *before, now = (_seen(frame) for frame in numbers[::-1])
    carry = law.init(before[0] if before else now)
    for seen in before:
        _, carry = law.observation.update(carry, seen)
    odometry = [pelvis_velocities(seen.qpos, seen.qvel).ravel() for seen in (now, *before[::-1])]
    return _Shown(law.observation.update(carry, now)[0][0], np.concatenate([numbers, odometry], axis=1))


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
        "leg": _leg(),
    }


def _leg() -> dict[str, Any]:
    """Geometry of a leg, and where a state has the joints of the left and of the right one (`robot.leg`)."""

    def places(index: Callable[..., np.ndarray]) -> list[list[int]]:
        return [index(*(f"{side}-{joint}" for joint in leg.JOINTS)).tolist() for side in cassie.SIDES]

    return {
        "hip_m": [leg.HIP_X, leg.HIP_Y],
        "yaw_axis_back_m": leg.YAW_AXIS_BACK,
        "pitch_axis_down_m": leg.PITCH_AXIS_DOWN,
        "plane_m": leg.PLANE_Y,
        "links_m": [[link.real, link.imag] for link in leg.LINKS.tolist()],
        "qpos": places(cassie.qpos_index),
        "qvel": places(cassie.qvel_index),
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
