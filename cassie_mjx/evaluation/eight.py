"""A figure of eight, and a follower that steers a policy along it.

The figure begins at the origin along x, goes round a circle to the left, and then round one to the right. The follower
is a pure pursuit: the robot is commanded to walk, at a fixed speed, on the circle that goes through a point of the
figure ahead of it and touches its heading where its pelvis is.
"""

from typing import NamedTuple

import numpy as np

from cassie_mjx.agents.types import Sensed
from cassie_mjx.motion.command import Command
from cassie_mjx.motion.schedule import LIMITS
from cassie_mjx.robot.arrays import Array, namespace
from cassie_mjx.robot.cassie import PELVIS_POSITION, PELVIS_QUATERNION
from cassie_mjx.robot.rotation import turned, yaw

RADIUS_M, SPEED_MPS = 2.0, 0.7
LENGTH_M = 4 * np.pi * RADIUS_M
AHEAD_M = 0.6
"""How far ahead on the figure the point is that the robot is steered to, m."""
# Ways on the figure from the last nearest point among which the next one is looked for, m.
_ONWARDS_M = np.linspace(0.0, 0.2, 41)


def point(way: Array) -> Array:
    """Where one is after a way [...], m, along the figure, [..., 2], m."""
    xp = namespace(way)
    angle = way / RADIUS_M % (4 * np.pi)
    side = xp.where(angle < 2 * np.pi, 1.0, -1.0)
    return RADIUS_M * xp.stack([xp.sin(angle), side * (1 - xp.cos(angle))], axis=-1)


def distance(place: np.ndarray) -> np.ndarray:
    """How far places [..., 2], m, are from the figure, [...], m."""
    centres = np.array([[0, RADIUS_M], [0, -RADIUS_M]])
    return np.abs(np.linalg.norm(place[..., None, :] - centres, axis=-1) - RADIUS_M).min(axis=-1)


def onwards(place: Array, way: Array) -> Array:
    """The way [B], m, to the nearest point of the figure to places [B, 2], m, from the last such way on."""
    xp = namespace(place, way)
    ways = way[:, None] + xp.asarray(_ONWARDS_M, dtype=way.dtype)
    off = ((point(ways) - place[:, None]) ** 2).sum(axis=-1)
    return way + xp.asarray(_ONWARDS_M, dtype=way.dtype)[off.argmin(axis=1)]


def pursuit(place: Array, heading: Array, ahead: Array) -> Command:
    """The command to walk on the circle from a place at a heading [B], rad, through a point [B, 2], m."""
    xp = namespace(place, heading)
    to = turned(ahead - place, -heading)
    # kappa = 2 y / d^2, omega = v kappa
    yaw_rate = 2 * SPEED_MPS * to[:, 1] / (to**2).sum(axis=1).clip(1e-6)
    told = Command.ahead(xp.full_like(yaw_rate, SPEED_MPS))
    return told._replace(yaw_rate=xp.clip(yaw_rate, *LIMITS[2].tolist()))


class Pursuit(NamedTuple):
    """The follower, as a `Pilot`."""

    way: Array
    """To the nearest point of the figure, along it, [B], m; 0 at the start."""

    def target(self, sensed: Sensed) -> tuple[Command, "Pursuit"]:
        """See `Pilot.target`."""
        place, heading = sensed.qpos[:, PELVIS_POSITION[:2]], yaw(sensed.qpos[:, PELVIS_QUATERNION])
        way = onwards(place, self.way)
        return pursuit(place, heading, point(way + AHEAD_M)), Pursuit(way)
