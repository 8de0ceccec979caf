"""The commands of training: which are drawn, and where the motion of an episode begins."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cassie_mjx.control.command import LEAST_STRIDE, STEP_OUT_MPS, MotionState, reference, since_landing
from cassie_mjx.control.path import Path
from cassie_mjx.motion.command import (
    FULL_STEERING_MPS,
    JOYSTICK,
    JOYSTICK_MPS,
    LEAST_STEERING,
    STRAIGHT,
    Command,
    Steering,
    speed_factors,
)
from cassie_mjx.motion.reference import ReferenceMotion, mean_speed
from cassie_mjx.physics.types import merge
from cassie_mjx.robot.arrays import Array, namespace
from cassie_mjx.robot.cassie import CONTROL_PERIOD_S, PELVIS_X
from cassie_mjx.robot.ground import START_X_M, Ground

# What the key of a speed is folded with for the steering, and for who is to stand.
_STEERING_KEY, _STAND_KEY = 2, 3
STILL_SHARE, STANDING_SHARE = 0.2, 0.8
"""Share of the commands that tell robots to stay where they are, where they are steered, and share of those that tell
them to stand; the others are to step on the spot."""
STANDING_TIMES = 4
"""How many times as long robots are told to stand as to walk by one command, for a stance may creep apart slowly."""


class CommandRange(NamedTuple):
    """The commands that a training draws."""

    speeds: tuple[float, float] = (1.0, 1.0)
    """Lowest and highest factor on the motion's speed."""
    steering: Steering = STRAIGHT


def command_range(motion: ReferenceMotion, speed: str, command: str) -> CommandRange:
    """What a training's speed and command ask for of a motion that has been stretched already.

    Raises:
      ValueError: `speed` is none, or a joystick is to command a motion that does not walk or has no two equal steps.
    """
    if command == "speed":
        return CommandRange(speed_factors(speed)[1])
    own, samples = float(mean_speed(motion)), len(motion.qpos)
    if own <= 0:
        raise ValueError("command=joystick stretches the reference, and this one does not walk; choose another.")
    if samples % 2 or samples < LEAST_STRIDE:
        raise ValueError(
            f"command=joystick needs a stride of an even number of samples, {LEAST_STRIDE} or more, and this reference "
            f"has {samples}; choose another."
        )
    low, high = JOYSTICK_MPS
    return CommandRange((low / own, high / own), JOYSTICK)


def limits(motion: ReferenceMotion, commands: CommandRange) -> np.ndarray:
    """Least and greatest of each component of a `Command` of a range, [4, 2]."""
    forward = np.asarray(commands.speeds) * float(mean_speed(motion))
    stand = np.array([0.0, float(commands.steering != STRAIGHT)])
    return np.stack([forward, *(np.array([-limit, limit]) for limit in commands.steering), stand])


def start_motion(
    motion: ReferenceMotion, time: jax.Array, command: Command, ground: Ground, speed: jax.Array
) -> MotionState:
    """The first moment of episodes.

    Args:
      motion: what is imitated.
      time: control step of the motion that they start at, [B]; robots that stand begin where a foot has just landed.
      command: now and as a target; robots on the way to standing or from it begin with steps.
      ground: of the robots, [B]; where it is not flat, the pelvis starts at `START_X_M`.
      speed: by which their pelvis is off the reference's velocity, [B], m/s; those that are too fast to stand step.
    """
    stands = (command.stand == 1) & (speed < STEP_OUT_MPS)
    now = command._replace(stand=stands.astype(command.forward.dtype))
    zeros = jnp.zeros_like(command.forward)
    landed = jnp.where(stands, time - since_landing(motion, time), time)
    state = MotionState(landed, jnp.zeros_like(time), now, command, zeros, Path(zeros, zeros, zeros))
    first, _ = reference(motion, state)
    return state._replace(origin_x=ground.uneven * (START_X_M - first[:, PELVIS_X]))


def command_of(motion: ReferenceMotion, factor: jax.Array) -> Command:
    """The command to walk straight ahead at a factor [B] on the motion's own speed."""
    return Command.ahead(factor * jnp.asarray(mean_speed(motion), jnp.float32))


def draw_factor(key: jax.Array, robots: int, factors: tuple[float, float]) -> jax.Array:
    """Factors on the motion's speed, [robots], from the range `factors`: one in ten its least, one in ten its greatest.

    Robots that move from speed to speed would seldom be at the ends of the range otherwise.
    """
    low, high = factors
    margin = (high - low) / 8
    return jax.random.uniform(key, (robots,), minval=low - margin, maxval=high + margin).clip(low, high)


def draw_command(
    motion: ReferenceMotion, key: jax.Array, robots: int, commands: CommandRange, share: Array | float = 1.0
) -> Command:
    """Commands from the range, leaves [robots]; each of their components is drawn as `draw_factor` does.

    Robots have a `share` [robots] of the range about the motion's own speed straight ahead; 0 is that speed alone.
    """
    told = command_of(motion, (1 - share) + share * draw_factor(key, robots, commands.speeds))
    if commands.steering == STRAIGHT:
        return told
    lateral_key, yaw_key = jax.random.split(jax.random.fold_in(key, _STEERING_KEY))
    sides = (share * draw_factor(each, robots, (-1.0, 1.0)) for each in (lateral_key, yaw_key))
    walking = steered(told.forward, commands.steering, *sides)
    still_key, stand_key = jax.random.split(jax.random.fold_in(key, _STAND_KEY))
    still = jax.random.bernoulli(still_key, STILL_SHARE * share, (robots,))
    stand = jax.random.bernoulli(stand_key, STANDING_SHARE, (robots,)).astype(told.forward.dtype)
    return merge(still, Command.ahead(0 * told.forward)._replace(stand=stand), walking)


def steered(forward: Array, steering: Steering, lateral: Array, yaw_rate: Array) -> Command:
    """The command at shares, -1 to 1, of the steering that robots have at a forward speed; all [B].

    The faster, the less: all of it up to 2.1 m/s, and half of it at 2.8 m/s.
    """
    xp = namespace(forward)
    beyond = (forward - FULL_STEERING_MPS) / (JOYSTICK_MPS[1] - FULL_STEERING_MPS)
    share = 1 - (1 - LEAST_STEERING) * xp.clip(beyond, 0, 1)
    return Command(forward, steering.lateral * share * lateral, steering.yaw_rate * share * yaw_rate, 0 * forward)


def paid(state: MotionState) -> jax.Array:
    """The share of the reward that robots are paid, [B]: for steps on the spot nothing, if they are told to stand.

    A robot that was paid for them learned to sway so much that it never had to stand.
    """
    now = state.command
    return jnp.where(now.on_the_spot & (state.target_command.stand > 0), now.stand, 1.0)


def redraw_target(
    motion: ReferenceMotion,
    state: MotionState,
    key: jax.Array,
    commands: CommandRange,
    mean_s: float,
    share: Array | float = 1.0,
) -> MotionState:
    """The same moment, after which some robots have another target: each every `mean_s` seconds on average.

    Those that are told to stand have theirs `STANDING_TIMES` as long. `share` is that of `draw_command`.
    """
    when_key, command_key = jax.random.split(key)
    targets = state.target_command
    lasts_s = mean_s * jnp.where(jnp.asarray(targets.stand) > 0, STANDING_TIMES, 1)
    new = jax.random.bernoulli(when_key, CONTROL_PERIOD_S / lasts_s, targets.forward.shape)
    drawn = draw_command(motion, command_key, len(new), commands, share)
    return state._replace(target_command=merge(new, drawn, targets))
