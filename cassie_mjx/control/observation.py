"""The 80-D observation as one table: what is where, and in which unit; and its mirror image.

Source: Xie et al. 2018: 40 numbers of the robot and the same 40 of the reference motion; pelvis x is left out.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cassie_mjx.physics.types import Array
from cassie_mjx.robot import cassie


class Entry(NamedTuple):
    """One group of the robot's half of the observation."""

    name: str
    source: str
    """Which of qpos and qvel it is read from."""
    addresses: np.ndarray
    """Where in qpos or qvel."""
    unit: str


_SENSED = [*cassie.ACTUATORS[:5], *cassie.SPRUNG_NAMES[:2], *cassie.ACTUATORS[5:], *cassie.SPRUNG_NAMES[2:]]
TABLE = (
    Entry("pelvis y, z (world)", "qpos", np.array([1, 2]), "m"),
    Entry("pelvis orientation (w, x, y, z)", "qpos", np.arange(3, 7), "1"),
    Entry("pelvis velocity (world)", "qvel", np.arange(0, 3), "m/s"),
    Entry("pelvis angular velocity (pelvis frame)", "qvel", np.arange(3, 6), "rad/s"),
    Entry("joint angles: " + ", ".join(_SENSED), "qpos", cassie.qpos_index(*_SENSED), "rad"),
    Entry("joint velocities, same order", "qvel", cassie.qvel_index(*_SENSED), "rad/s"),
)
_ADDRESSES = np.concatenate([entry.addresses + (cassie.NQ if entry.source == "qvel" else 0) for entry in TABLE])
HALF = len(_ADDRESSES)
SIZE = 2 * HALF


def _mirror_places() -> np.ndarray:
    qpos, qvel = np.split(1 + np.arange(cassie.NQ + cassie.NV), [cassie.NQ])
    sources = np.concatenate([cassie.mirror_qpos(qpos), cassie.mirror_qvel(qvel)])[_ADDRESSES]
    places = np.array([1 + np.flatnonzero(abs(source) - 1 == _ADDRESSES)[0] for source in sources])
    return np.sign(np.tile(sources, 2)) * np.concatenate([places, HALF + places])


MIRROR = _mirror_places()
"""[80], the reflection of an observation: places, from 1 on, that its numbers come from, with the sign they get."""
HIP_PITCH = cassie.qpos_index("left-hip-pitch", "right-hip-pitch")
REFERENCE_HIP_PITCH = HALF + np.array([np.flatnonzero(address == _ADDRESSES)[0] for address in HIP_PITCH])
"""Where an observation has the reference's hip pitch angles, left and right."""


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


def mirror(seen: Array) -> Array:
    """Reflect observations [..., 80] in the plane y = 0: what was seen of the left leg is seen of the right one."""
    return seen[..., abs(MIRROR) - 1] * np.sign(MIRROR)


def second_step(hip_pitch: Array) -> jax.Array:
    """Whether a reference is in the second of its two steps, mirror images: left hip pitch less than the right one's.

    Args:
      hip_pitch: the reference's hip pitch angles, left and right, [..., 2], rad.

    Returns:
      [..., 1], bool.
    """
    left, right = jnp.split(hip_pitch, 2, axis=-1)
    return left < right


def folded(seen: Array) -> jax.Array:
    """Observations [..., 80], those of the second step as in a mirror."""
    return jnp.where(second_step(seen[..., REFERENCE_HIP_PITCH]), mirror(seen), seen)


def unfolded(action: jax.Array, hip_pitch: Array) -> jax.Array:
    """What actions [..., 10] on folded observations are in the world: those of the second step as in a mirror.

    Args:
      action: residuals on the reference angles of the active joints, rad.
      hip_pitch: the reference's hip pitch angles, left and right, [..., 2], rad.
    """
    image: jax.Array = cassie.mirror_active(action)
    return jnp.where(second_step(hip_pitch), image, action)


def symmetric(act: Callable[[jax.Array], jax.Array]) -> Callable[[Array], jax.Array]:
    """The policy of both steps that does in the second, as in a mirror, what `act` does in the first.

    Args:
      act: observations [..., 80] to actions [..., 10].
    """

    def act_in_both(seen: Array) -> jax.Array:
        return unfolded(act(folded(seen)), seen[..., REFERENCE_HIP_PITCH])

    return act_in_both


def describe() -> list[str]:
    """A line for each group of the observation: slice, content, unit."""
    lines, start = [], 0
    for half in ("robot", "reference"):
        for entry in TABLE:
            stop = start + len(entry.addresses)
            lines.append(f"{start}:{stop} {half} {entry.name} [{entry.unit}]")
            start = stop
    return lines
