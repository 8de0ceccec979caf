"""The 80-D observation as one table: what is where, and in which unit.

Source: Xie et al. 2018: 40 numbers of the robot and the same 40 of the reference motion; pelvis x is left out.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cassie_mjx import robot
from cassie_mjx.physics.types import Array


class Entry(NamedTuple):
    """One group of the robot's half of the observation."""

    name: str
    source: str
    """Which of qpos and qvel it is read from."""
    addresses: np.ndarray
    """Where in qpos or qvel."""
    unit: str


_SENSED = [*robot.ACTUATORS[:5], *robot.SPRUNG_NAMES[:2], *robot.ACTUATORS[5:], *robot.SPRUNG_NAMES[2:]]
TABLE = (
    Entry("pelvis y, z (world)", "qpos", np.array([1, 2]), "m"),
    Entry("pelvis orientation (w, x, y, z)", "qpos", np.arange(3, 7), "1"),
    Entry("pelvis velocity (world)", "qvel", np.arange(0, 3), "m/s"),
    Entry("pelvis angular velocity (pelvis frame)", "qvel", np.arange(3, 6), "rad/s"),
    Entry("joint angles: " + ", ".join(_SENSED), "qpos", robot.qpos_index(*_SENSED), "rad"),
    Entry("joint velocities, same order", "qvel", robot.qvel_index(*_SENSED), "rad/s"),
)
_ADDRESSES = np.concatenate([entry.addresses + (robot.NQ if entry.source == "qvel" else 0) for entry in TABLE])
HALF = len(_ADDRESSES)
SIZE = 2 * HALF


def build(qpos: Array, qvel: Array, reference_qpos: Array, reference_qvel: Array) -> jax.Array:
    """Observations, [B, 80]: the robot's half, then the reference's, each as in `TABLE`.

    Args:
      qpos: of the robots as sensed, [B, 35].
      qvel: of the robots as sensed, [B, 32].
      reference_qpos: of the reference motion one control step ahead, [B, 35].
      reference_qvel: of the reference motion one control step ahead, [B, 32].
    """
    robots = jnp.concatenate([qpos, qvel], axis=-1)[..., _ADDRESSES]
    reference = jnp.concatenate([reference_qpos, reference_qvel], axis=-1)[..., _ADDRESSES]
    return jnp.concatenate([robots, reference], axis=-1)


def describe() -> list[str]:
    """A line for each group of the observation: slice, content, unit."""
    lines, start = [], 0
    for half in ("robot", "reference"):
        for entry in TABLE:
            stop = start + len(entry.addresses)
            lines.append(f"{start}:{stop} {half} {entry.name} [{entry.unit}]")
            start = stop
    return lines
