"""The commands of training: which speeds are drawn, and where the motion of an episode begins."""

import jax
import jax.numpy as jnp

from cassie_mjx.control.command import MotionState, reference
from cassie_mjx.motion.command import Command
from cassie_mjx.motion.reference import ReferenceMotion, mean_speed
from cassie_mjx.robot.cassie import CONTROL_PERIOD_S, PELVIS_X
from cassie_mjx.robot.ground import START_X_M, Ground


def start_motion(motion: ReferenceMotion, time: jax.Array, command: Command, ground: Ground) -> MotionState:
    """The first moment of episodes.

    Args:
      motion: what is imitated.
      time: control step of the motion that they start at, [B].
      command: now and as a target.
      ground: of the robots, [B]; where it is not flat, the pelvis starts at `START_X_M`.
    """
    state = MotionState(time, jnp.zeros_like(time), command, command, jnp.zeros_like(command.forward))
    first, _ = reference(motion, state)
    return state._replace(origin_x=ground.uneven * (START_X_M - first[:, PELVIS_X]))


def command_of(motion: ReferenceMotion, factor: jax.Array) -> Command:
    """The command to walk at a factor [B] on the motion's own speed."""
    return Command(factor * jnp.asarray(mean_speed(motion), jnp.float32))


def draw_factor(key: jax.Array, robots: int, factors: tuple[float, float]) -> jax.Array:
    """Factors on the motion's speed, [robots], from the range `factors`: one in ten its least, one in ten its greatest.

    Robots that move from speed to speed would seldom be at the ends of the range otherwise.
    """
    low, high = factors
    margin = (high - low) / 8
    return jax.random.uniform(key, (robots,), minval=low - margin, maxval=high + margin).clip(low, high)


def redraw_target(
    motion: ReferenceMotion, state: MotionState, key: jax.Array, factors: tuple[float, float], mean_s: float
) -> MotionState:
    """The same moment, after which some robots have another target: each every `mean_s` seconds on average."""
    when_key, speed_key = jax.random.split(key)
    targets = state.target_command.forward
    new = jax.random.bernoulli(when_key, CONTROL_PERIOD_S / mean_s, targets.shape)
    drawn = command_of(motion, draw_factor(speed_key, len(new), factors)).forward
    return state._replace(target_command=Command(jnp.where(new, drawn, targets)))
