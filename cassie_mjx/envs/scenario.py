"""The scenarios of training: what is drawn at random for each robot, as part of the task."""

import math
from dataclasses import dataclass, replace
from typing import Annotated

import jax
import jax.numpy as jnp

from cassie_mjx.configuration.values import Checked, Range
from cassie_mjx.envs.dynamics import DynamicsRange, vary
from cassie_mjx.physics.types import Scenario, merge
from cassie_mjx.robot.arrays import Array
from cassie_mjx.robot.cassie import CONTROL_PERIOD_S
from cassie_mjx.robot.ground import Ground
from cassie_mjx.robot.model import steps_per_control

PUSH_S = 0.2
"""Duration of a push, s (Xie et al. 2018)."""

LEVELS = 8
"""Levels above 0 that terrain is drawn from, evenly spaced: MuJoCo C compiles a model for each."""
LEVEL_UP, LEVEL_DOWN, LEAST_LEVEL = 0.01, 0.04, 0.1
"""How a level of the curriculum moves: it settles where four of five pushes are survived."""
ALL_LEVEL = 0.4
"""The level of the curriculum from which on terrain, delay and commands are drawn from their whole ranges."""
TRAINING_SEEDS = 4
"""Rough grounds that robots are trained on, of `ROUGH_SEEDS`."""
# What the key of a scenario is folded with for the dynamics; up to 4 it would give the others' keys again.
_DYNAMICS_KEY = 5


@dataclass(frozen=True)
class ScenarioConfig(Checked):
    """How far robots are disturbed; the default is not at all. What is drawn is uniform from 0 to the value given."""

    push_n: Annotated[float, Range(0, 1000)] = 0.0
    """Force of a push at the pelvis, N: horizontal, in any direction, for 0.2 s, one push after the
    other."""
    push_curriculum: bool = False
    """Whether disturbances grow as robots learn to bear pushes. Every robot has a direction of its own that it is
    pushed in, and a level, from 0.1 to 1: its pushes are drawn up to `push_n` times the level, which rises with each
    push that is over and drops with each fall. Terrain, delay and the range of commands grow with it:
    at 0.1 there is neither of the first two, and the command is the motion's own speed straight ahead; from 0.4 on all
    are whole."""
    undisturbed_share: Annotated[float, Range(0, 1)] = 0.0
    """Share of the robots that nothing of this disturbs, so that walking undisturbed is still practised."""
    push_backward: Annotated[float, Range(0, 1)] = 1.0
    """Factor on what a push has along -x: backward, robots bear only weaker pushes than in other directions."""
    push_pause_s: Annotated[float, Range(0, 60)] = 4.0
    """Time from the start of the episode, or from the end of the push before, to a push, s."""
    terrain_m: Annotated[float, Range(0, 1)] = 0.0
    """Height h of the terrain z = h sin x, m, one an episode."""
    slope_rad: Annotated[float, Range(0, 0.6)] = 0.0
    """Angle of a slope up, down, to the left or to the right, rad, one an episode. Of the kinds of terrain that are
    above 0, each episode has one."""
    steps_m: Annotated[float, Range(0, 0.5)] = 0.0
    """Height of every other step of 0.7 m, m, one an episode."""
    rough_m: Annotated[float, Range(0, 0.5)] = 0.0
    """Band that 95% of the heights of rough ground lie in, m, one an episode."""
    delay_s: Annotated[float, Range(0, 0.1)] = 0.0
    """Age of the state that policy and PD loop see, s, one an episode; whole physics steps, rounded up."""

    @property
    def active(self) -> bool:
        """Whether anything is disturbed."""
        return bool(self.push_n or self.delay_s or self.terrains)

    @property
    def terrains(self) -> dict[str, float]:
        """The highest level of each kind of terrain."""
        levels = {"sine": self.terrain_m, "slope": self.slope_rad, "steps": self.steps_m, "rough": self.rough_m}
        return {kind: level for kind, level in levels.items() if level}

    @property
    def scene(self) -> str:
        """The least scene that has it all."""
        if not self.terrains:
            return "flat"
        return "rough" if self.rough_m else "terrain"

    def delay_steps(self, physics_hz: float) -> int:
        """Longest delay, physics steps."""
        return math.ceil(self.delay_s * physics_hz - 1e-9)


def is_disturbed(config: ScenarioConfig, robots: int) -> jax.Array:
    """Which of `robots` are not left alone, [robots], bool: always the same, the last of them."""
    return jnp.arange(robots) >= round(config.undisturbed_share * robots)


def draw_scenario(
    config: ScenarioConfig,
    key: jax.Array,
    robots: int,
    physics_hz: float,
    kd_scale: float = 1.0,
    level: Array | float = 1.0,
    dynamics: DynamicsRange | None = None,
) -> Scenario:
    """Scenarios of whole episodes, up to the end of their first push.

    Args:
      config: the ranges.
      key: used up here.
      robots: B.
      physics_hz: physics steps a second.
      kd_scale: factor on the D gains of all robots.
      level: of the curriculum, [B]: share of `config.push_n` that pushes are drawn up to; see `ALL_LEVEL`.
      dynamics: how far robots differ from the model; None for not at all.
    """
    force_key, direction_key, pause_key, terrain_key, delay_key = jax.random.split(key, 5)
    acts = is_disturbed(config, robots)
    force = acts * level * jax.random.uniform(force_key, (robots,), maxval=config.push_n)
    angle = jax.random.uniform(direction_key, (robots,), maxval=2 * jnp.pi)
    if config.push_curriculum:
        # Each of the n disturbed robots has an n-th of the circle.
        angle = (2 * jnp.pi * jnp.arange(robots) + angle) / jnp.maximum(acts.sum(), 1)
    share = grown(jnp.full(robots, level))
    forward, left = jnp.cos(angle), jnp.sin(angle)
    forward *= jnp.where(forward < 0, config.push_backward, 1)
    # A push starts with a control step: within one, it would cut the physics' calls of all robots in two.
    longest = math.ceil(config.push_pause_s / CONTROL_PERIOD_S)
    start = jax.random.randint(pause_key, (robots, 1), 0, longest + 1) * steps_per_control(physics_hz)
    scenario = Scenario(
        push=(force[:, None] * jnp.stack([forward, left, jnp.zeros(robots)], axis=1))[:, None],
        push_start=start,
        push_stop=start + round(PUSH_S * physics_hz),
        delay=_up_to(delay_key, share * config.delay_steps(physics_hz)) * acts,
        ground=_draw_ground(config, terrain_key, acts, share),
        kd_scale=jnp.full(robots, kd_scale),
    )
    if dynamics is None:
        return scenario
    return vary(scenario, dynamics, jax.random.fold_in(key, _DYNAMICS_KEY), physics_hz)


def _up_to(key: jax.Array, highest: jax.Array) -> jax.Array:
    """Whole numbers from 0 to the highest, [B], uniform."""
    # A share of 1 may be a little less in single precision, and floor would lose the highest.
    return jax.random.randint(key, highest.shape, 0, jnp.floor(highest + 1e-3).astype(jnp.int32) + 1)


def _draw_ground(config: ScenarioConfig, key: jax.Array, acts: jax.Array, share: jax.Array) -> Ground:
    """One of the kinds of terrain for each robot that `acts` [B] says, at one of nine levels, flat among them.

    Robots get the levels up to their `share` [B] of the highest.
    """
    robots = len(acts)
    level = acts * _up_to(key, share * LEVELS) / LEVELS
    kind_key, side_key, seed_key = jax.random.split(jax.random.fold_in(key, 1), 3)
    kinds = config.terrains
    chosen = jax.random.randint(kind_key, (robots,), 0, max(len(kinds), 1))
    levels = {kind: level * highest * (chosen == i) for i, (kind, highest) in enumerate(kinds.items())}
    zeros = jnp.zeros(robots)
    sides = jnp.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    side = sides[jax.random.randint(side_key, (robots,), 0, len(sides))]
    return Ground(
        sine=levels.get("sine", zeros),
        slope=levels.get("slope", zeros)[:, None] * side,
        steps=levels.get("steps", zeros),
        rough=levels.get("rough", zeros),
        seed=jax.random.randint(seed_key, (robots,), 0, TRAINING_SEEDS),
    )


def first_level(config: ScenarioConfig, robots: int) -> jax.Array:
    """The levels of the curriculum that training begins with, [robots]; 1 without one, and where nothing disturbs."""
    return jnp.full(robots, LEAST_LEVEL if config.push_curriculum and config.active else 1.0)


def grown(level: jax.Array) -> jax.Array:
    """The share, 0 to 1, of the ranges that robots of these levels [B] have of all but pushes, [B]."""
    return jnp.clip((level - LEAST_LEVEL) / (ALL_LEVEL - LEAST_LEVEL), 0, 1)


def next_level(config: ScenarioConfig, level: jax.Array, present: Scenario, step: Array, fallen: Array) -> jax.Array:
    """The levels [B] of the curriculum after a control step: higher where a push is over, lower where robots fell.

    Args:
      config: whether there is a curriculum.
      level: before, [B].
      present: what acted until now.
      step: physics steps since the start of the episode, [B].
      fallen: [B], bool.
    """
    if not (config.push_curriculum and config.active):
        return level
    over = present.push_stop[:, 0] <= step
    return jnp.clip(level + LEVEL_UP * over - LEVEL_DOWN * fallen, LEAST_LEVEL, 1)


def renew_scenario(
    config: ScenarioConfig,
    key: jax.Array,
    present: Scenario,
    step: Array,
    ended: Array,
    physics_hz: float,
    level: Array | float = 1.0,
    dynamics: DynamicsRange | None = None,
) -> Scenario:
    """What acts from the next control step on: a new push where the last is over, all anew where the episode is.

    Args:
      config: the ranges.
      key: used up here.
      present: what acted until now.
      step: physics steps since the start of the episode, [B].
      ended: robots that start a new episode, [B], bool.
      physics_hz: physics steps a second.
      level: see `draw_scenario`.
      dynamics: see `draw_scenario`.
    """
    fresh = draw_scenario(config, key, len(step), physics_hz, level=level, dynamics=dynamics)
    fresh = replace(fresh, kd_scale=present.kd_scale)
    now = step[:, None]
    pushed_again = replace(present, push=fresh.push, push_start=now + fresh.push_start, push_stop=now + fresh.push_stop)
    return merge(ended, fresh, merge(present.push_stop[:, 0] <= step, pushed_again, present))
