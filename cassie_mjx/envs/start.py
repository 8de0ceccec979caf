"""How far off the reference motion episodes begin."""

import jax
import jax.numpy as jnp

from cassie_mjx.envs.config import CAPTURE_S, WalkConfig
from cassie_mjx.envs.types import StartOffset


def draw_offset(config: WalkConfig, velocity_key: jax.Array, place_key: jax.Array, robots: int) -> StartOffset:
    """Velocities up to `start_velocity_mps` off in any direction, and places up to `start_offset_m` beside the line.

    Args:
      config: the limits.
      velocity_key: used up here.
      place_key: used up here.
      robots: B.
    """
    size_key, angle_key = jax.random.split(velocity_key)
    size = config.start_velocity_mps * jnp.square(jax.random.uniform(size_key, (robots, 1)))
    angle = jax.random.uniform(angle_key, (robots,), maxval=2 * jnp.pi)
    velocity = size * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
    limit = config.start_offset_m
    y = jax.random.uniform(place_key, (robots,), minval=-limit, maxval=limit)
    # xi = x + v sqrt(h / g) stays where it was.
    return StartOffset(velocity, jnp.stack([0 * y, y], axis=1) - CAPTURE_S * velocity)
