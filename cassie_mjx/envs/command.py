"""Where robots are along the reference motion, and how its speed changes: pure functions of a `Clock`."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from cassie_mjx.envs.scenario import CREST_X_M
from cassie_mjx.envs.types import Clock
from cassie_mjx.motion.reference import RAMP_PER_S, ReferenceMotion, sample, stretch_states
from cassie_mjx.robot import cassie
from cassie_mjx.robot.model import CONTROL_PERIOD_S

_X = int(cassie.PELVIS_POSITION[0])


def start(motion: ReferenceMotion, phase: jax.Array, speed: jax.Array, terrain: jax.Array) -> Clock:
    """The first moment of episodes.

    Args:
      motion: the stride.
      phase: sample of the stride that they start at, [B].
      speed: factor on the motion's speed, [B], now and as commanded.
      terrain: height h of the ground, [B], m; where it is above 0, the pelvis starts above a crest.
    """
    zeros = jnp.zeros_like(phase)
    clock = Clock(phase, zeros, zeros, speed, speed, jnp.zeros_like(speed))
    first, _ = reference(motion, clock)
    return replace(clock, origin_x=(terrain > 0) * (CREST_X_M - first[:, _X]))


def reference(motion: ReferenceMotion, clock: Clock, ahead: int = 0) -> tuple[jax.Array, jax.Array]:
    """The motion at each robot's speed, `ahead` control steps from now: (qpos [B, 35], qvel [B, 32])."""
    qpos, qvel = stretch_states(*sample(motion, clock.phase + ahead, clock.stride), clock.speed)
    return qpos.at[:, _X].add(clock.origin_x), qvel


def tick(motion: ReferenceMotion, clock: Clock) -> Clock:
    """One control step later."""
    phase, samples = clock.phase + 1, motion.qpos.shape[0]
    return replace(clock, phase=phase % samples, stride=clock.stride + phase // samples, step=clock.step + 1)


def draw_speed(key: jax.Array, robots: int, speeds: tuple[float, float]) -> jax.Array:
    """Speeds to command, [robots], from the range `speeds`: one in ten its lowest, one in ten its highest.

    Robots that move from speed to speed would seldom be at the ends of the range otherwise.
    """
    low, high = speeds
    margin = (high - low) / 8
    return jax.random.uniform(key, (robots,), minval=low - margin, maxval=high + margin).clip(low, high)


def commanded(clock: Clock, key: jax.Array, speeds: tuple[float, float], mean_s: float) -> Clock:
    """The same moment, after which some robots are commanded another speed: each every `mean_s` seconds on average."""
    when_key, speed_key = jax.random.split(key)
    new = jax.random.bernoulli(when_key, CONTROL_PERIOD_S / mean_s, clock.command.shape)
    return replace(clock, command=jnp.where(new, draw_speed(speed_key, len(new), speeds), clock.command))


def paced(motion: ReferenceMotion, clock: Clock) -> Clock:
    """The same moment at a speed nearer to the one commanded, by 0.625 a second; x does not jump."""
    step = RAMP_PER_S * CONTROL_PERIOD_S
    speed = clock.speed + jnp.clip(clock.command - clock.speed, -step, step)
    x = sample(motion, clock.phase, clock.stride)[0][:, _X]
    # x0' + s' x = x0 + s x
    return replace(clock, speed=speed, origin_x=clock.origin_x + (clock.speed - speed) * x)
