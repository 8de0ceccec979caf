"""What a critic may see that no robot senses."""

import jax
import jax.numpy as jnp
import numpy as np

from cassie_mjx.control.law import canonicalize
from cassie_mjx.control.observation import OBSERVATIONS, Seen
from cassie_mjx.physics.types import Scenario
from cassie_mjx.robot import cassie
from cassie_mjx.robot.arrays import Array
from cassie_mjx.robot.dynamics import Dynamics, encoded
from cassie_mjx.robot.rotation import turned

LEAD_M = 0.25
"""Unit of how far a robot is ahead: half of what ends an episode, so of the order of 1."""
ERROR = {"m": 0.1, "1": 0.1, "m/s": 0.5, "rad": 0.2, "rad/s": 2.0}
"""Units of how far a number of the state is from the reference's, by its own unit."""
PUSH_N, DELAY_S, HEIGHT_M, SLOPE_RAD = 100.0, 0.01, 0.1, 0.2
"""Units of what disturbs a robot."""
COM_M, OFFSET_RAD, TORQUE_DELAY_S = 0.05, 0.02, 0.005
"""Units of what a robot is like."""


def ahead(lead: Array) -> jax.Array:
    """How far robots are ahead of the reference motion, `lead` [B], m, as a critic sees it, [B, 1], within +-10."""
    return jnp.clip(jnp.asarray(lead, jnp.float32) / LEAD_M, -10, 10)[:, None]


def errors(seen: Seen, mirrored: Array) -> jax.Array:
    """How far the state is from the reference's, number by number of the full state, [B, 40], in `ERROR`, within +-10.

    Args:
      seen: the true state, and the reference ahead.
      mirrored: whether the policy sees them in a mirror, [B, 1], bool.
    """
    full = OBSERVATIONS["full"]
    state = canonicalize(full, full.update(full.init(seen), seen)[0], mirrored)
    robot, reference = jnp.split(state, 2, axis=1)
    units = np.concatenate([np.full(term.size, ERROR[term.unit]) for term in full.terms])[: robot.shape[1]]
    return jnp.clip((robot - reference) / units, -10, 10).astype(jnp.float32)


def disturbances(scenario: Scenario, step: Array, timestep: float, heading: Array, mirrored: Array) -> jax.Array:
    """What disturbs robots: the present push and the slope along the path, the age of what is sensed, heights, [B, 8].

    All are of the order of 1.

    Args:
      scenario: of the robots.
      step: physics steps since the start of the episode, [B].
      timestep: of the physics, s.
      heading: of the path, [B], rad.
      mirrored: whether the policy sees them in a mirror, [B, 1], bool.
    """
    scenario = jax.tree.map(jnp.asarray, scenario)
    ground, side = scenario.ground, jnp.where(mirrored, -1.0, 1.0)
    force, slope = scenario.force(step)[:, :2] / PUSH_N, ground.slope / SLOPE_RAD
    aside = jnp.concatenate([jnp.ones_like(side), side], axis=1)
    along = [turned(each, -heading) * aside for each in (force, slope)]
    late = scenario.delay[:, None] * timestep / DELAY_S
    heights = jnp.stack([ground.sine, ground.steps, ground.rough], axis=1) / HEIGHT_M
    return jnp.concatenate([*along, late, heights], axis=1).astype(jnp.float32)


def dynamics(of_robots: Dynamics, share: Array, timestep: float, mirrored: Array) -> jax.Array:
    """What robots are like, [B, 25], of the order of 1 and 0 for one that is as the model has it.

    Mass of the whole, friction, damping, springs, strength, P and D gains; the pelvis' centre of mass; how late torques
    are; what encoders are off by.

    Args:
      of_robots: their dynamics.
      share: of the bodies in the mass of the whole, [26].
      timestep: of the physics, s.
      mirrored: whether the policy sees them in a mirror, [B, 1], bool.
    """
    d = jax.tree.map(jnp.asarray, of_robots)
    offset = encoded(jnp.zeros((len(mirrored), cassie.NQ)), d)
    offset = jnp.where(mirrored, cassie.mirror_qpos(offset), offset)[:, cassie.ENCODER_QPOS]
    com = jnp.where(mirrored, d.com * jnp.array([1, -1, 1]), d.com)
    factors = [d.mass @ share, d.friction, d.damping, d.stiffness, d.strength, d.p_gain, d.d_gain]
    late = jnp.maximum(d.torque_delay, 0)[:, None] * timestep / TORQUE_DELAY_S
    seen = [jnp.stack(factors, axis=1) - 1, com / COM_M, late, offset / OFFSET_RAD]
    return jnp.concatenate(seen, axis=1).astype(jnp.float32)
