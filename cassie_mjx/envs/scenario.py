"""The scenarios of training: what is drawn at random for each robot, as part of the task."""

import math
from dataclasses import dataclass, replace
from typing import Annotated

import jax
import jax.numpy as jnp

from cassie_mjx.configuration.values import Checked, Range
from cassie_mjx.physics.types import Scenario, merge
from cassie_mjx.robot.arrays import Array
from cassie_mjx.robot.cassie import CONTROL_PERIOD_S
from cassie_mjx.robot.model import steps_per_control

PUSH_S = 0.2
"""Duration of a push, s (Xie et al. 2018)."""

TERRAIN_HEIGHTS = 8
"""Heights above 0 that terrain is drawn from, evenly spaced: MuJoCo C compiles a model for each."""


@dataclass(frozen=True)
class ScenarioConfig(Checked):
    """How far robots are disturbed; the default is not at all. What is drawn is uniform from 0 to the value given."""

    push_n: Annotated[float, Range(0, 1000)] = 0.0
    """Force of a push at the pelvis, N: horizontal, in any direction, for 0.2 s, one push after the
    other."""
    push_backward: Annotated[float, Range(0, 1)] = 1.0
    """Factor on what a push has along -x: backward, robots bear only weaker pushes than in other directions."""
    push_pause_s: Annotated[float, Range(0, 60)] = 4.0
    """Time from the start of the episode, or from the end of the push before, to a push, s."""
    terrain_m: Annotated[float, Range(0, 1)] = 0.0
    """Height h of the terrain z = h sin x, m, one an episode."""
    delay_s: Annotated[float, Range(0, 0.1)] = 0.0
    """Age of the state that policy and PD loop see, s, one an episode; whole physics steps, rounded up."""

    @property
    def active(self) -> bool:
        """Whether anything is disturbed."""
        return bool(self.push_n or self.terrain_m or self.delay_s)

    def delay_steps(self, physics_hz: float) -> int:
        """Longest delay, physics steps."""
        return math.ceil(self.delay_s * physics_hz - 1e-9)


def draw_scenario(
    config: ScenarioConfig, key: jax.Array, robots: int, physics_hz: float, kd_scale: float = 1.0
) -> Scenario:
    """Scenarios of whole episodes, up to the end of their first push.

    Args:
      config: the ranges.
      key: used up here.
      robots: B.
      physics_hz: physics steps a second.
      kd_scale: factor on the D gains of all robots.
    """
    force_key, direction_key, pause_key, terrain_key, delay_key = jax.random.split(key, 5)
    force = jax.random.uniform(force_key, (robots, 1), maxval=config.push_n)
    angle = jax.random.uniform(direction_key, (robots,), maxval=2 * jnp.pi)
    forward, left = jnp.cos(angle), jnp.sin(angle)
    forward *= jnp.where(forward < 0, config.push_backward, 1)
    # A push starts with a control step: within one, it would cut the physics' calls of all robots in two.
    longest = math.ceil(config.push_pause_s / CONTROL_PERIOD_S)
    start = jax.random.randint(pause_key, (robots, 1), 0, longest + 1) * steps_per_control(physics_hz)
    level = jax.random.randint(terrain_key, (robots,), 0, TERRAIN_HEIGHTS + 1)
    return Scenario(
        push=(force * jnp.stack([forward, left, jnp.zeros(robots)], axis=1))[:, None],
        push_start=start,
        push_stop=start + round(PUSH_S * physics_hz),
        delay=jax.random.randint(delay_key, (robots,), 0, config.delay_steps(physics_hz) + 1),
        ground=level * (config.terrain_m / TERRAIN_HEIGHTS),
        kd_scale=jnp.full(robots, kd_scale),
    )


def renew_scenario(
    config: ScenarioConfig, key: jax.Array, present: Scenario, step: Array, ended: Array, physics_hz: float
) -> Scenario:
    """What acts from the next control step on: a new push where the last is over, all anew where the episode is.

    Args:
      config: the ranges.
      key: used up here.
      present: what acted until now.
      step: physics steps since the start of the episode, [B].
      ended: robots that start a new episode, [B], bool.
      physics_hz: physics steps a second.
    """
    fresh = draw_scenario(config, key, len(step), physics_hz)
    fresh = replace(fresh, kd_scale=present.kd_scale)
    now = step[:, None]
    pushed_again = replace(present, push=fresh.push, push_start=now + fresh.push_start, push_stop=now + fresh.push_stop)
    return merge(ended, fresh, merge(present.push_stop[:, 0] <= step, pushed_again, present))
