"""The robot as a linear inverted pendulum (Kajita et al. 2001): all its mass in one point, which keeps its height.

In the heading frame of `kinematics`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from cassie_mjx.heuristic.kinematics import Sensed
from cassie_mjx.physics.types import BodyState

GRAVITY = 9.81


def rate(height: jax.Array) -> jax.Array:
    """Omega of the pendulum x'' = omega^2 x whose mass is `height` (m) over its foot, 1/s."""
    # omega = sqrt(g / h)
    return jnp.sqrt(GRAVITY / height)


class Masses(NamedTuple):
    """What the robot's momentum needs to know of its bodies."""

    mass: np.ndarray
    """[26], kg."""
    inertia: np.ndarray
    """About the principal axes, [26, 3], kg m^2."""

    @classmethod
    def of(cls, model: mujoco.MjModel) -> "Masses":
        """Of a compiled model."""
        return cls(model.body_mass.astype(np.float32), model.body_inertia.astype(np.float32))


def velocity(masses: Masses, bodies: BodyState, now: Sensed, pivot: jax.Array) -> jax.Array:
    """Velocity [2] of the point mass with the robot's angular momentum about `pivot`: steadier than that of the CoM."""
    mass, inertia = masses
    omega = bodies.cvel[:, :3]
    speeds = bodies.cvel[:, 3:] + jnp.cross(omega, bodies.xipos - bodies.com)
    arm = bodies.xipos - now.pelvis_w - now.heading @ pivot
    spin = jnp.einsum("bij,bj,bkj,bk->bi", bodies.ximat, inertia, bodies.ximat, omega)
    # L = sum m_i (x_i - p) x v_i + I_i omega_i;  v = (L_y, -L_x) / (m h)
    momentum = jnp.sum(mass[:, None] * jnp.cross(arm, speeds) + spin, axis=0) @ now.heading
    return jnp.stack([momentum[1], -momentum[0]]) / (mass.sum() * (now.com - pivot)[2])


def velocity_after(r: jax.Array, velocity: jax.Array, tau: jax.Array) -> jax.Array:
    """Velocity [2] of the pendulum in tau seconds, for its arm r [3] from the stance sole."""
    omega = rate(r[2])
    # v- = omega sinh(omega tau) r + cosh(omega tau) v
    return omega * jnp.sinh(omega * tau) * r[:2] + jnp.cosh(omega * tau) * velocity
