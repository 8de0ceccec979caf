"""The path that a command bends: its frame in the world, and states of robots seen from it, for NumPy and JAX alike.

The reference motion goes along the x axis of the path's frame. A yaw rate turns the frame, a lateral velocity moves it
to the left. With the command straight ahead it stays where it is, to the last bit.
"""

from typing import NamedTuple

import numpy as np

from cassie_mjx.motion.command import Command
from cassie_mjx.robot import cassie
from cassie_mjx.robot.arrays import Array, namespace
from cassie_mjx.robot.cassie import CONTROL_PERIOD_S, PELVIS_X, PELVIS_Z
from cassie_mjx.robot.rotation import turned, turned_orientation

LEASH_M = 0.3
"""How far to the side of the path a robot may be before the path comes after it, where the command steers, m. Training
has a leash of its own (`walk.leash_m`)."""

_AFTER_Y, _AFTER_QUATERNION = PELVIS_Z, int(cassie.PELVIS_QUATERNION[-1]) + 1
_AFTER_VELOCITY_Y = cassie.HORIZONTAL_VELOCITY.stop


class Path(NamedTuple):
    """Frames of paths in the world."""

    x: Array
    """World x of the frame's origin, [B], m."""
    y: Array
    """World y of the frame's origin, [B], m."""
    heading: Array
    """Of the frame's x axis, [B], rad, to the left of the world's."""

    @classmethod
    def world(cls, robots: int) -> "Path":
        """The world's own frame, for B = `robots` of them."""
        return cls(*np.zeros((3, robots), np.float32))


def into(path: Path, qpos: Array, qvel: Array) -> tuple[Array, Array]:
    """States of the world, qpos [B, 35] and qvel [B, 32], in the frames of paths; joints are as they were.

    The pelvis' angular velocity is in its own frame and does not change.
    """
    return _turned(_moved(qpos, -path.x, -path.y), qvel, -path.heading)


def out_of(path: Path, qpos: Array, qvel: Array) -> tuple[Array, Array]:
    """States in the frames of paths, qpos [B, 35] and qvel [B, 32], in the world."""
    qpos, qvel = _turned(qpos, qvel, path.heading)
    return _moved(qpos, path.x, path.y), qvel


def bend(path: Path, command: Command, now: Array, ahead: Array, lead: Array | float = 0.0) -> Path:
    """The path one control step later.

    It turns about the place of the reference in the middle of the step: a walk at v m/s and omega rad/s goes round a
    circle of v / omega m.

    Args:
      path: of now.
      command: of the robots.
      now: reference at the beginning of the step, in the path's frame, [B, 35].
      ahead: reference at its end, [B, 35].
      lead: how far ahead of the reference the place to turn about is, [B], m.
    """
    xp = namespace(now, path.x, command.forward)
    x, y = (now + ahead)[:, [PELVIS_X, cassie.PELVIS_Y]].T / 2
    place = xp.stack([x + lead, y], axis=-1)
    turn, way = CONTROL_PERIOD_S * command.yaw_rate, CONTROL_PERIOD_S * command.lateral
    # o' = o + R(h) p - R(h') p + d e_y, with e_y at the mean of both headings
    moved = turned(place, path.heading) - turned(place, path.heading + turn)
    return _by(path, command, moved + _leftwards(path.heading + turn / 2, way), turn)


def bend_beside(path: Path, command: Command, now: Array, ahead: Array, x: Array) -> Path:
    """The path of robots one control step later, bent about the place beside which they are themselves.

    No robot observes how far ahead of the reference it is. If the path turned about the reference, a robot that is
    ahead would come to lie to the side of it.

    Arguments as those of `bend`, and `x` of their pelvis, in the path's frame, [B], m.
    """
    return bend(path, command, now, ahead, x - now[:, PELVIS_X])


def stay_beside(path: Path, command: Command, now: Array, qpos: Array, qvel: Array) -> Path:
    """The path within `LEASH_M` of robots at qpos [B, 35] and qvel [B, 32], whose reference is `now` [B, 35]."""
    aside = (into(path, qpos, qvel)[0] - now)[:, cassie.PELVIS_Y]
    return shift(path, command, aside - namespace(aside).clip(aside, -LEASH_M, LEASH_M))


def shift(path: Path, command: Command, aside: Array) -> Path:
    """The path moved to its left by `aside` [B], m, where the command steers; else it stays."""
    return _by(path, command, _leftwards(path.heading, aside), 0 * aside)


def _by(path: Path, command: Command, moved: Array, turn: Array) -> Path:
    """The path moved by [B, 2], m, in the world and turned by [B], rad, where the command steers; else it stays."""
    xp = namespace(path.x, moved)
    later = Path(path.x + moved[:, 0], path.y + moved[:, 1], path.heading + turn)
    return Path(*(xp.where(command.steers, new, old) for new, old in zip(later, path, strict=True)))


def _leftwards(heading: Array, way: Array) -> Array:
    """A way [B], m, to the left of headings [B], rad, in the world, [B, 2]."""
    xp = namespace(heading, way)
    return turned(xp.stack([xp.zeros_like(way), way], axis=-1), heading)


def _moved(qpos: Array, x: Array, y: Array) -> Array:
    """States qpos [B, 35] carried by x and y [B], m."""
    xp = namespace(qpos, x)
    place = qpos[:, :_AFTER_Y] + xp.stack([x, y], axis=-1)
    return xp.concatenate([place, qpos[:, _AFTER_Y:]], axis=1)


def _turned(qpos: Array, qvel: Array, angle: Array) -> tuple[Array, Array]:
    """States [B, 35] and [B, 32] turned to the left about the frame's origin by angles [B], rad."""
    xp = namespace(qpos, angle)
    place = turned(qpos[:, :_AFTER_Y], angle)
    orientation = turned_orientation(qpos[:, cassie.PELVIS_QUATERNION], angle)
    velocity = turned(qvel[:, cassie.HORIZONTAL_VELOCITY], angle)
    height, joints = qpos[:, PELVIS_Z : PELVIS_Z + 1], qpos[:, _AFTER_QUATERNION:]
    return (
        xp.concatenate([place, height, orientation, joints], axis=1),
        xp.concatenate([velocity, qvel[:, _AFTER_VELOCITY_Y:]], axis=1),
    )
