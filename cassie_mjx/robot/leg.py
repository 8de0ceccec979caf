"""Geometry of Cassie's legs, and leg odometry: the velocity of a pelvis whose foot rests; for NumPy and JAX alike."""

from collections.abc import Callable, Iterable

import numpy as np

from cassie_mjx.robot import cassie
from cassie_mjx.robot.arrays import Array, namespace
from cassie_mjx.robot.rotation import rotated, turned

# From cassie.xml, m. The hip-roll axis passes the pelvis at (HIP_X, +-HIP_Y); behind it stands the yaw axis, below it
# lies the pitch axis; the plane in which the links move is PLANE_Y inwards.
HIP_X, HIP_Y = 0.021, 0.135
YAW_AXIS_BACK, PITCH_AXIS_DOWN, PLANE_Y = 0.07, 0.09, 0.0045
# The way from joint to joint in that plane, as complex numbers in the frame of the link: along x, which is down in a
# thigh that hangs, + i along y, which is forward there.
HIP_TO_KNEE, KNEE_TO_SHIN = 0.12 + 0j, 0.06068 + 0.04741j
SHIN_TO_TARSUS, TARSUS_TO_FOOT = 0.43476 + 0.02j, 0.408 - 0.04j

_LINKS = np.array([HIP_TO_KNEE, KNEE_TO_SHIN, SHIN_TO_TARSUS, TARSUS_TO_FOOT, complex(*cassie.SOLE_AXIS[:2])])
_IN_PLANE = ("hip-pitch", "knee", "shin", "tarsus", "foot")


def _of_both_legs(index: Callable[..., np.ndarray], joints: Iterable[str]) -> np.ndarray:
    """Addresses of these joints of the left and of the right leg, [2, n]."""
    joints = tuple(joints)
    return np.stack([index(*(f"{side}-{joint}" for joint in joints)) for side in cassie.SIDES])


_PLANE_QPOS, _PLANE_QVEL = (_of_both_legs(index, _IN_PLANE) for index in (cassie.qpos_index, cassie.qvel_index))
_ROLL_QPOS, _ROLL_QVEL, _YAW_QPOS, _YAW_QVEL = (
    _of_both_legs(index, [joint])[:, 0]
    for joint in ("hip-roll", "hip-yaw")
    for index in (cassie.qpos_index, cassie.qvel_index)
)


def soles(qpos: Array, qvel: Array) -> tuple[Array, Array]:
    """Where the middles of the feet are in the pelvis' frame, [B, 2, 3], m, and how fast they move there, m/s.

    They are the middles of the axes of the feet's capsules, left and right, by the angles and velocities of the seven
    joints of each leg that have an encoder.

    Args:
      qpos: of the robots, [B, 35].
      qvel: of the robots, [B, 32].
    """
    xp, outwards = namespace(qpos), np.array([1.0, -1.0])
    # In the plane of the links: p = sum_k e^(i a_k) l_k, with a_k the sum of the angles of joints 1 to k
    angle, rate = xp.cumsum(qpos[:, _PLANE_QPOS], axis=2), xp.cumsum(qvel[:, _PLANE_QVEL], axis=2)
    down = xp.cos(angle) * _LINKS.real - xp.sin(angle) * _LINKS.imag
    forward = xp.sin(angle) * _LINKS.real + xp.cos(angle) * _LINKS.imag
    x, z = forward.sum(axis=2), -PITCH_AXIS_DOWN - down.sum(axis=2)
    dx, dz = (rate * down).sum(axis=2), (rate * forward).sum(axis=2)
    y = xp.zeros_like(x) - PLANE_Y * outwards
    # Turned by the yaw, about z: p' = R p and dp'/dt = R (dp/dt + omega x p)
    yaw_rate, yaw = qvel[:, _YAW_QVEL], qpos[:, _YAW_QPOS]
    dx, dy = _split(turned(xp.stack([dx - yaw_rate * y, yaw_rate * x], axis=-1), yaw))
    x, y = _split(turned(xp.stack([x, y], axis=-1), yaw))
    x = x - YAW_AXIS_BACK
    # Turned by the roll, about x, likewise.
    roll_rate, roll = qvel[:, _ROLL_QVEL], qpos[:, _ROLL_QPOS]
    dy, dz = _split(turned(xp.stack([dy - roll_rate * z, dz + roll_rate * y], axis=-1), roll))
    y, z = _split(turned(xp.stack([y, z], axis=-1), roll))
    return xp.stack([x + HIP_X, y + HIP_Y * outwards, z], axis=-1), xp.stack([dx, dy, dz], axis=-1)


def pelvis_velocities(qpos: Array, qvel: Array) -> Array:
    """How fast the pelvis moves if the left foot rests on the ground, and if the right one does, [B, 2, 3], m/s.

    By orientation, gyro and the joints of the legs alone: what sensors tell of the pelvis' velocity, in the world.

    Args:
      qpos: of the robots as sensed, [B, 35].
      qvel: of the robots as sensed, [B, 32].
    """
    place, speed = soles(qpos, qvel)
    # v = -R (omega x p + dp/dt)
    turning = qvel[:, None, cassie.PELVIS_ANGULAR_VELOCITY]
    return -rotated(qpos[:, None, cassie.PELVIS_QUATERNION], namespace(qpos).cross(turning, place) + speed)


def _split(vectors: Array) -> tuple[Array, Array]:
    return vectors[..., 0], vectors[..., 1]
