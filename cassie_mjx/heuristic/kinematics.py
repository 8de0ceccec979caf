"""Kinematics of Cassie's legs for the heuristic controller: the robot in its heading frame, and the legs' inverse.

Frames: `_w` is the world; the heading frame has its origin at the pelvis and is turned about the vertical by the yaw
of the pelvis, x forward, y left, z up. A side is 0 (left) or 1 (right).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cassie_mjx.physics.types import BodyState
from cassie_mjx.robot import cassie
from cassie_mjx.robot.leg import (
    HIP_TO_KNEE,
    HIP_X,
    HIP_Y,
    KNEE_TO_SHIN,
    PITCH_AXIS_DOWN,
    PLANE_Y,
    SHIN_TO_TARSUS,
    TARSUS_TO_FOOT,
    YAW_AXIS_BACK,
)

# Knee + tarsus: 13.1 degrees for a straight leg, 12.1 for one bent to the limit; this is the angle in a walk.
KNEE_AND_TARSUS = np.deg2rad(12.6)
# The two links as complex numbers: along the thigh + i forward of it; the shin's in the knee's frame.
THIGH_AND_TARSUS = HIP_TO_KNEE + TARSUS_TO_FOOT * np.exp(1j * KNEE_AND_TARSUS)
KNEE_AND_SHIN = KNEE_TO_SHIN + SHIN_TO_TARSUS
# Sum of the sagittal joint angles at which the sole, from heel to toe, is level: its direction is 90 degrees from down.
LEVEL_FOOT = np.pi / 2 - np.arctan2(*(cassie.TOE - cassie.HEEL)[[1, 0]])

# The sole is the lower side of the foot's capsule; its midpoint is below the midpoint of the capsule's axis.
SOLE_AXIS = cassie.SOLE_AXIS.astype(np.float32)
SOLE_BELOW_AXIS = np.array([0.0, 0.0, cassie.FOOT_RADIUS_M], np.float32)
_LEVEL_AXIS = complex(*SOLE_AXIS[:2]) * np.exp(1j * LEVEL_FOOT)
ANKLE_HEIGHT = _LEVEL_AXIS.real + SOLE_BELOW_AXIS[2]
ANKLE_FROM_SOLE = np.array([-_LEVEL_AXIS.imag, 0.0, ANKLE_HEIGHT], np.float32)

LEG_BODIES = np.stack([cassie.body_index(f"left-{j}", f"right-{j}") for j in cassie.ACTIVE[:4]], axis=1)
TARSUS_BODIES = cassie.body_index("left-tarsus", "right-tarsus")


def inverse_kinematics(ankle: jax.Array, hip_yaw: jax.Array, side: jax.Array) -> jax.Array:
    """Joint angles that put the ankle (the foot joint's axis) where it is wanted, in closed form, springs unloaded.

    The achilles rod keeps the tarsus parallel to the thigh, so the leg is two links: thigh and tarsus as one, the shin
    as the other. Off by up to 4 mm, because knee + tarsus is not quite constant. A point out of reach gets the nearest
    knee angle.

    Args:
      ankle: in the pelvis' own frame, [3], m.
      hip_yaw: hip yaw angle to be used, rad.
      side: 0 left, 1 right.

    Returns:
      Hip roll, hip yaw, hip pitch, knee, [4], rad.
    """
    sigma = 1.0 - 2.0 * side
    x, y, z = ankle[0] - HIP_X + YAW_AXIS_BACK, ankle[1] - HIP_Y * sigma, ankle[2]
    # The leg's plane lies y_o beside the yaw axis: p = Rx(roll) (x, y'', z''), and (x, y'') = Rz(psi) (x_l, y_o).
    y_o = -PLANE_Y * sigma
    x_l = (x + y_o * jnp.sin(hip_yaw)) / jnp.cos(hip_yaw)
    y_2 = x_l * jnp.sin(hip_yaw) + y_o * jnp.cos(hip_yaw)
    z_2 = -jnp.sqrt(jnp.maximum(y**2 + z**2 - y_2**2, 1e-4))
    roll = jnp.arctan2(z, y) - jnp.arctan2(z_2, y_2)
    z_l = z_2 + PITCH_AXIS_DOWN
    # L^2 = |A|^2 + |B|^2 + 2 |A| |B| cos(angle between A and B)
    a, b = np.abs(THIGH_AND_TARSUS), np.abs(KNEE_AND_SHIN)
    cosine = (x_l**2 + z_l**2 - a**2 - b**2) / (2 * a * b)
    bend = -jnp.arccos(jnp.clip(cosine, -0.9999, 0.9999)) + np.angle(THIGH_AND_TARSUS)
    along = THIGH_AND_TARSUS.real + b * jnp.cos(bend)
    across = THIGH_AND_TARSUS.imag + b * jnp.sin(bend)
    pitch = jnp.arctan2(x_l, -z_l) - jnp.arctan2(across, along)
    return jnp.stack([roll, hip_yaw, pitch, bend - np.angle(KNEE_AND_SHIN)])


def level_foot(hip_pitch: jax.Array, pelvis_pitch: jax.Array) -> jax.Array:
    """Foot angle, rad, that keeps the sole level at this hip pitch and pelvis pitch (nose down), springs unloaded."""
    # The sagittal angles add up to LEVEL_FOOT: q_foot = LEVEL_FOOT - (q_hip + q_knee + q_tarsus) + theta
    return LEVEL_FOOT - hip_pitch - KNEE_AND_TARSUS + pelvis_pitch


class Sensed(NamedTuple):
    """The robot in the heading frame: m, rad, m/s, rad/s."""

    heading: jax.Array  # rotation heading to world [3, 3]
    pelvis_w: jax.Array  # [3]
    tilt: jax.Array  # rotation pelvis to heading [3, 3]
    angles: jax.Array  # roll, yaw (of the world), pitch [3]
    rates: jax.Array  # of the same [3]
    velocity: jax.Array  # of the pelvis [3]
    com: jax.Array  # [3]
    soles: jax.Array  # midpoints, left and right [2, 3]
    ankles: jax.Array  # [2, 3]
    q: jax.Array  # active joints, left and right [2, 5]
    qdot: jax.Array  # [2, 5]

    def local(self, point_w: jax.Array) -> jax.Array:
        """A point of the world, [..., 3], m, in the heading frame."""
        return (point_w - self.pelvis_w) @ self.heading


def soles_w(bodies: BodyState) -> jax.Array:
    """Midpoints of the soles, left and right, [2, 3], m."""
    return bodies.xpos[cassie.FOOT_BODIES] + bodies.xmat[cassie.FOOT_BODIES] @ SOLE_AXIS - SOLE_BELOW_AXIS


def sense(qpos: jax.Array, qvel: jax.Array, bodies: BodyState) -> Sensed:
    """The robot in its heading frame, from qpos [35], qvel [32] and the poses of its bodies."""
    pelvis = bodies.xmat[cassie.PELVIS_BODY]
    origin = bodies.xpos[cassie.PELVIS_BODY]
    yaw = jnp.arctan2(pelvis[1, 0], pelvis[0, 0])
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    heading = jnp.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    tilt = heading.T @ pelvis
    return Sensed(
        heading=heading,
        pelvis_w=origin,
        tilt=tilt,
        angles=jnp.stack([jnp.arctan2(pelvis[2, 1], pelvis[2, 2]), yaw, -jnp.arcsin(jnp.clip(pelvis[2, 0], -1, 1))]),
        rates=(tilt @ qvel[3:6])[jnp.array([0, 2, 1])],
        velocity=qvel[:3] @ heading,
        com=(bodies.com - origin) @ heading,
        soles=(soles_w(bodies) - origin) @ heading,
        ankles=(bodies.xpos[cassie.FOOT_BODIES] - origin) @ heading,
        q=qpos[cassie.ACTIVE_QPOS].reshape(2, 5),
        qdot=qvel[cassie.ACTIVE_QVEL].reshape(2, 5),
    )


def leg_jacobian(bodies: BodyState, now: Sensed, side: jax.Array) -> jax.Array:
    """Rows d sole / d (hip roll, yaw, pitch, knee), [4, 3], m/rad; the knee moves the tarsus without turning it."""
    axes = bodies.xmat[LEG_BODIES][side, :, :, 2] @ now.heading
    anchors = now.local(bodies.xpos[LEG_BODIES][side])
    sole, tarsus = now.soles[side], now.local(bodies.xpos[TARSUS_BODIES][side])
    return jnp.cross(axes, jnp.stack([sole, sole, sole, tarsus]) - anchors)
