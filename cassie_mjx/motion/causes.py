"""What most likely went wrong with a motion that is none of Cassie: a sentence each, and what would undo it."""

from collections.abc import Callable

import numpy as np

from cassie_mjx.motion.recording import heading_x
from cassie_mjx.motion.reference import QUATERNIONS, ReferenceMotion
from cassie_mjx.robot import cassie

_LEGS = [cassie.qpos_index(*(name for name, *_ in cassie.JOINTS if name.startswith(side))) for side in cassie.SIDES]
_LEGS_V = [cassie.qvel_index(*(name for name, *_ in cassie.JOINTS if name.startswith(side))) for side in cassie.SIDES]
_ANGLES = np.setdiff1d(np.arange(cassie.NQ), [*cassie.PELVIS_POSITION, *QUATERNIONS.ravel()])


def _reordered(which: slice) -> Callable[[ReferenceMotion], ReferenceMotion]:
    """Quaternions of these joints from x y z w to w x y z."""

    def undo(motion: ReferenceMotion) -> ReferenceMotion:
        qpos = motion.qpos.copy()
        qpos[:, QUATERNIONS[which]] = np.roll(qpos[:, QUATERNIONS[which]], 1, axis=-1)
        return motion._replace(qpos=qpos)

    return undo


def _legs_exchanged(motion: ReferenceMotion) -> ReferenceMotion:
    qpos, qvel = motion.qpos.copy(), motion.qvel.copy()
    for states, (left, right) in ((qpos, _LEGS), (qvel, _LEGS_V)):
        states[:, left], states[:, right] = states[:, right], states[:, left]
    return motion._replace(qpos=qpos, qvel=qvel)


def _in_radians(motion: ReferenceMotion) -> ReferenceMotion:
    qpos = motion.qpos.copy()
    qpos[:, _ANGLES] = np.deg2rad(qpos[:, _ANGLES])
    return motion._replace(qpos=qpos)


def _in_metres(motion: ReferenceMotion) -> ReferenceMotion:
    qpos = motion.qpos.copy()
    qpos[:, cassie.PELVIS_POSITION] /= 1000
    return motion._replace(qpos=qpos)


def _along_x(motion: ReferenceMotion) -> ReferenceMotion:
    qpos, qvel = heading_x(motion.qpos, motion.qvel)
    return motion._replace(qpos=qpos, qvel=qvel)


CAUSES = (
    ("its quaternions look like x y z w, and MuJoCo's order is w x y z", _reordered(slice(None))),
    ("its pelvis quaternion looks like x y z w, and MuJoCo's order is w x y z", _reordered(slice(1))),
    ("its achilles-rod quaternions look like x y z w, and MuJoCo's order is w x y z", _reordered(slice(1, None))),
    ("its legs look swapped: MuJoCo's order has the left one first", _legs_exchanged),
    ("its joint angles look like degrees, and are to be rad", _in_radians),
    ("its positions look like millimetres, and are to be m", _in_metres),
    ("it looks turned about the vertical: it is to go along x", _along_x),
)
"""Sentences, and functions from a motion that has gone wrong so to the motion that was meant."""
