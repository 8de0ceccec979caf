"""Observations as lists of terms: what is where, in which unit and frame, its mirror image and its history.

Array functions for NumPy and JAX alike, over robots (axis B). A new term is a line here; a list of terms has a name
that the configuration of the task knows (`OBSERVATIONS`).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from cassie_mjx.motion.command import Command
from cassie_mjx.robot import cassie
from cassie_mjx.robot.arrays import Array, namespace
from cassie_mjx.robot.leg import pelvis_velocities
from cassie_mjx.robot.rotation import align


class Seen(NamedTuple):
    """What an observation is made of, all in the frame of the path."""

    qpos: Array
    """Of the robots as sensed, [B, 35]."""
    qvel: Array
    """Of the robots as sensed, [B, 32]."""
    reference_qpos: Array
    """Of the reference motion one control step ahead, [B, 35]."""
    reference_qvel: Array
    """Of the reference motion one control step ahead, [B, 32]."""
    command: Command | None = None
    """Of the robots; None where an agent has one speed alone."""


@dataclass(frozen=True)
class Term:
    """One group of numbers in an observation."""

    name: str
    unit: str
    frame: str
    compute: Callable[[Seen], Array]
    """Its values, [B, size]."""
    permutation: np.ndarray
    """[size], which of its numbers the mirror image in the plane y = 0 has in each place."""
    sign: np.ndarray
    """[size], with which sign."""
    history: int = 1
    """Control steps that are observed, the present one included, newest first."""

    @property
    def size(self) -> int:
        """Numbers of one control step."""
        return len(self.sign)


@dataclass(frozen=True, eq=False)
class Observation:
    """A list of terms: lays them side by side, term by term, and each term's history newest first."""

    terms: tuple[Term, ...]
    noisy: bool = False
    """Whether training adds noise to the robot's state before the terms are computed from it (`NOISE`)."""

    @property
    def size(self) -> int:
        """Numbers in an observation, O."""
        return sum(term.size * term.history for term in self.terms)

    @cached_property
    def mirror(self) -> tuple[np.ndarray, np.ndarray]:
        """Permutation and sign, [O] each, that take an observation to its mirror image in the plane y = 0."""
        permutations, signs, start = [], [], 0
        for term in [each for each in self.terms for _ in range(each.history)]:
            permutations.append(start + term.permutation)
            signs.append(term.sign)
            start += term.size
        return np.concatenate(permutations), np.concatenate(signs)

    def init(self, seen: Seen) -> Array:
        """The carry of robots that have always seen this: earlier frames, newest first, [B, H - 1, F]."""
        frame = self._frame(seen)
        longest = max(term.history for term in self.terms)
        return namespace(frame).repeat(frame[:, None], longest - 1, axis=1)

    def update(self, carry: Array, seen: Seen) -> tuple[Array, Array]:
        """An observation [B, O], and the next carry.

        Args:
          carry: of `init` or the last `update`.
          seen: what there is to see now.
        """
        frame = self._frame(seen)
        xp = namespace(frame)
        if not carry.shape[1]:
            return frame, carry
        frames = xp.concatenate([frame[:, None], carry], axis=1)
        parts, start = [], 0
        for term in self.terms:
            recent = frames[:, : term.history, start : start + term.size]
            parts.append(recent.reshape(len(frame), -1))
            start += term.size
        return xp.concatenate(parts, axis=1), frames[:, :-1]

    def mirrored(self, observation: Array) -> Array:
        """Observations [..., O] reflected in the plane y = 0: what was seen of the left leg is seen of the right."""
        permutation, sign = self.mirror
        return observation[..., permutation] * sign

    def describe(self) -> list[str]:
        """A line for each term: slice, content, unit."""
        lines, start = [], 0
        for term in self.terms:
            stop = start + term.size * term.history
            past = f", {term.history} control steps" if term.history > 1 else ""
            lines.append(f"{start}:{stop} {term.name}{term.frame and f' ({term.frame})'}{past} [{term.unit}]")
            start = stop
        return lines

    def _frame(self, seen: Seen) -> Array:
        values = [term.compute(seen) for term in self.terms]
        return namespace(*values).concatenate(values, axis=1)


_JOINTS = [*cassie.ACTUATORS[:5], *cassie.SPRUNG_NAMES[:2], *cassie.ACTUATORS[5:], *cassie.SPRUNG_NAMES[2:]]


def _state_term(half: str, name: str, unit: str, frame: str, source: str, addresses: np.ndarray) -> Term:
    """The numbers at `addresses` of qpos or qvel, of the robot or of the reference."""
    field = source if half == "robot" else f"reference_{source}"
    mirror, size = (cassie.mirror_qpos, cassie.NQ) if source == "qpos" else (cassie.mirror_qvel, cassie.NV)
    image = mirror(1 + np.arange(size))[addresses]
    places = np.array([np.flatnonzero(abs(number) - 1 == addresses)[0] for number in image])

    def compute(seen: Seen) -> Array:
        return getattr(seen, field)[:, addresses]

    return Term(f"{half} {name}", unit, frame, compute, places, np.sign(image))


def _orientation(term: Term) -> Term:
    """The term with its quaternion's sign, which means nothing, brought to that of the reference's."""

    def compute(seen: Seen) -> Array:
        return align(term.compute(seen), seen.reference_qpos[:, cassie.PELVIS_QUATERNION])

    return replace(term, compute=compute)


def _state_terms(half: str) -> tuple[Term, ...]:
    """Xie et al. 2018: 40 numbers of the robot, and the same 40 of the reference motion; pelvis x is left out."""
    return (
        _state_term(half, "pelvis y, z", "m", "world", "qpos", np.array([cassie.PELVIS_Y, cassie.PELVIS_Z])),
        _orientation(_state_term(half, "pelvis orientation", "1", "w, x, y, z", "qpos", cassie.PELVIS_QUATERNION)),
        _state_term(half, "pelvis velocity", "m/s", "world", "qvel", cassie.PELVIS_VELOCITY),
        _state_term(half, "pelvis angular velocity", "rad/s", "pelvis frame", "qvel", cassie.PELVIS_ANGULAR_VELOCITY),
        _state_term(half, "joint angles: " + ", ".join(_JOINTS), "rad", "", "qpos", cassie.qpos_index(*_JOINTS)),
        _state_term(half, "joint velocities, same order", "rad/s", "", "qvel", cassie.qvel_index(*_JOINTS)),
    )


def _odometry() -> Term:
    """How fast the pelvis moves as each leg tells, left and right."""

    def compute(seen: Seen) -> Array:
        return pelvis_velocities(seen.qpos, seen.qvel).reshape(-1, 6)

    name = "robot pelvis velocity by leg odometry: left, right"
    return Term(name, "m/s", "world", compute, np.array([3, 4, 5, 0, 1, 2]), np.array([1, -1, 1, 1, -1, 1]))


NOISE = {"m": 0.02, "1": 0.01, "m/s": 0.1, "rad": 0.01, "rad/s": 0.2}
"""Half-width of the uniform noise on each number that is sensed or estimated, by its unit.

0.01 on a quaternion turns it by 0.02 rad. Joint angles and the gyro as in mjlab's training. Joint velocities have
nearly the standard deviation of roadrunner's, 0.1 rad/s."""

NOISE_QPOS, NOISE_QVEL = np.zeros(cassie.NQ), np.zeros(cassie.NV)
"""The same for each number of qpos, [35], and of qvel, [32]; 0 where nothing senses it."""
NOISE_QPOS[cassie.PELVIS_POSITION], NOISE_QVEL[cassie.PELVIS_VELOCITY] = NOISE["m"], NOISE["m/s"]
NOISE_QPOS[cassie.PELVIS_QUATERNION], NOISE_QVEL[cassie.PELVIS_ANGULAR_VELOCITY] = NOISE["1"], NOISE["rad/s"]
NOISE_QPOS[cassie.ENCODER_QPOS], NOISE_QVEL[cassie.qvel_index(*cassie.ENCODERS)] = NOISE["rad"], NOISE["rad/s"]


def with_noise(qpos: Array, qvel: Array, noise: Array) -> tuple[Array, Array]:
    """States qpos [B, 35] and qvel [B, 32] as sensed with noise [B, 67], in half-widths."""
    return qpos + NOISE_QPOS * noise[:, : cassie.NQ], qvel + NOISE_QVEL * noise[:, cassie.NQ :]


HISTORY = 4
"""Control steps that "sensors_history" has of what is sensed, the present one included: 0.128 s."""

_ROBOT, _REFERENCE = _state_terms("robot"), _state_terms("reference")
# No sensor of the robot tells where its pelvis is, and how fast that moves.
_SENSED = (*(term for term in _ROBOT if term.unit not in ("m", "m/s")), _odometry())
_NO_PLACE = tuple(term for term in _REFERENCE if term.unit != "m")

OBSERVATIONS = {
    "full": Observation((*_ROBOT, *_REFERENCE)),
    "estimated": Observation((*_ROBOT, *_REFERENCE), noisy=True),
    "sensors": Observation((*_SENSED, *_NO_PLACE), noisy=True),
    "sensors_history": Observation((*(replace(term, history=HISTORY) for term in _SENSED), *_NO_PLACE), noisy=True),
}
"""Lists of terms by name.

"full" is the 80-D state of Xie et al. 2018, "estimated" the same with noise in training. "sensors" has what the robot's
IMU and encoders tell, and what follows from that of the pelvis' velocity while a foot rests on the ground, with noise
in training. Its reference has a velocity, which shows the command, and no place. "sensors_history" has it of the last
steps, too.
"""
