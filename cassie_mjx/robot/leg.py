"""Geometry of Cassie's legs, and leg odometry: the velocity of a pelvis whose foot rests; for NumPy and JAX alike."""

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

LINKS = np.array([HIP_TO_KNEE, KNEE_TO_SHIN, SHIN_TO_TARSUS, TARSUS_TO_FOOT, complex(*cassie.SOLE_AXIS[:2])])
"""The links of the plane one after the other, down to the middle of the foot's capsule, [5]."""

JOINTS = ("hip-roll", "hip-yaw", "hip-pitch", "knee", "shin", "tarsus", "foot")
"""Joints between pelvis and foot that have an encoder; the last five turn about axes across the plane."""

# Addresses of these joints of the left and of the right leg, [2, 7].
_QPOS, _QVEL = (
    np.stack([index(*(f"{side}-{joint}" for joint in JOINTS)) for side in cassie.SIDES])
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
    angles, rates = qpos[:, _QPOS], qvel[:, _QVEL]
    # In the plane of the links: p = sum_k e^(i a_k) l_k, with a_k the sum of the angles of joints 1 to k
    angle, rate = xp.cumsum(angles[..., 2:], axis=2), xp.cumsum(rates[..., 2:], axis=2)
    down = xp.cos(angle) * LINKS.real - xp.sin(angle) * LINKS.imag
    forward = xp.sin(angle) * LINKS.real + xp.cos(angle) * LINKS.imag
    x, z = forward.sum(axis=2), -PITCH_AXIS_DOWN - down.sum(axis=2)
    dx, dz = (rate * down).sum(axis=2), (rate * forward).sum(axis=2)
    y = xp.zeros_like(x) - PLANE_Y * outwards
    # Turned by the yaw, about z: p' = R p and dp'/dt = R (dp/dt + omega x p)
    yaw, yaw_rate = angles[..., 1], rates[..., 1]
    dx, dy = _split(turned(xp.stack([dx - yaw_rate * y, yaw_rate * x], axis=-1), yaw))
    x, y = _split(turned(xp.stack([x, y], axis=-1), yaw))
    x = x - YAW_AXIS_BACK
    # Turned by the roll, about x, likewise.
    roll, roll_rate = angles[..., 0], rates[..., 0]
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
