"""Imitation reward: four terms between 0 and 1, two ways to scale them, one weighted sum.

`plain` is the reward that Xie et al. 2018 print; `weighted` has the scales of the same group's later code
(osudrl/apex).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cassie_mjx.robot import cassie
from cassie_mjx.robot.arrays import Array
from cassie_mjx.robot.rotation import align


class Terms(NamedTuple):
    """The unweighted terms, each [B], 1 on the reference."""

    joint: jax.Array
    position: jax.Array
    orientation: jax.Array
    spring: jax.Array


class Scale(NamedTuple):
    """Factors on squared errors before the exponential."""

    joint: np.ndarray
    """On each of the ten active joints, 1/rad²."""
    spring: float
    """On the two shins, 1/rad²."""
    orientation: float = 1.0
    """On the vector part of the pelvis' quaternion, which is half the angle, 1/rad²."""


SCALES = {
    "plain": Scale(np.ones(cassie.NU), 1.0),
    "weighted": Scale(30 * np.tile([0.15, 0.15, 0.1, 0.05, 0.05], 2), 1000.0),
}
WEIGHTS = (0.5, 0.3, 0.1, 0.1)
"""Of the terms in their order: joint, position, orientation, spring."""


def terms(scale: Scale, qpos: Array, reference: Array) -> Terms:
    """Similarity of robots and reference.

    Args:
      scale: one of `SCALES`.
      qpos: of the robots, [B, 35]; pelvis z counted from the ground below.
      reference: qpos of the reference motion at the same time and from the same origin of x, [B, 35].
    """
    # r = exp(-sum of scaled squared errors)
    error = jnp.square(qpos - reference)
    wanted = reference[..., cassie.PELVIS_QUATERNION]
    orientation = jnp.square(align(qpos[..., cassie.PELVIS_QUATERNION], wanted) - wanted)
    return Terms(
        joint=jnp.exp(-(error[..., cassie.ACTIVE_QPOS] * scale.joint).sum(axis=-1)),
        position=jnp.exp(-error[..., cassie.PELVIS_POSITION].sum(axis=-1)),
        orientation=jnp.exp(-scale.orientation * orientation[..., 1:].sum(axis=-1)),
        spring=jnp.exp(-scale.spring * error[..., cassie.SHIN_QPOS].sum(axis=-1)),
    )


def total(values: Terms) -> jax.Array:
    """Weighted sum of the terms, [B], 0 to 1."""
    # r = 0.5 r_joint + 0.3 r_position + 0.1 r_orientation + 0.1 r_spring
    return jnp.stack([weight * value for weight, value in zip(WEIGHTS, values, strict=True)]).sum(axis=0)
