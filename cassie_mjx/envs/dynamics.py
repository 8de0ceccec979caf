"""How far robots of a task differ from the model, and the draw of what each one is like."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

import jax
import jax.numpy as jnp
import numpy as np

from cassie_mjx.physics.types import Scenario
from cassie_mjx.robot.dynamics import Dynamics


@dataclass(frozen=True)
class DynamicsRange:
    """Lowest and highest of what is drawn, uniformly and each by itself; see `Dynamics` for what is a factor."""

    mass: tuple[float, float]
    """Of each body."""
    com: tuple[float, float]
    """Along each axis, m."""
    friction: tuple[float, float]
    damping: tuple[float, float]
    stiffness: tuple[float, float]
    strength: tuple[float, float]
    p_gain: tuple[float, float]
    d_gain: tuple[float, float]
    encoder_offset: tuple[float, float]
    """Of each encoder, rad."""
    torque_delay: tuple[float, float]
    """s; whole physics steps, rounded."""
    slope: tuple[float, float]
    """Of the ground along each axis, rad."""

    def scaled(self, scale: float) -> "DynamicsRange":
        """A range `scale` times as far about the model: factors to that power, the others times it."""

        # However wide its range, a factor stays above 0.
        def end(name: str, value: float) -> float:
            return value**scale if np.all(getattr(Dynamics.nominal(), name, 0) == 1) else value * scale

        return DynamicsRange(**{name: (end(name, low), end(name, high)) for name, (low, high) in vars(self).items()})

    def delay_steps(self, physics_hz: float) -> int:
        """Longest delay of torques, physics steps."""
        return math.ceil(self.torque_delay[1] * physics_hz - 1e-9)


RANGES: Mapping[str, DynamicsRange] = {
    "moderate": DynamicsRange(
        mass=(0.85, 1.15),
        com=(-0.03, 0.03),
        friction=(0.5, 1.1),
        damping=(0.5, 2.0),
        stiffness=(0.85, 1.15),
        strength=(0.9, 1.0),
        p_gain=(0.9, 1.1),
        d_gain=(0.9, 1.1),
        encoder_offset=(-0.01, 0.01),
        torque_delay=(0.0015, 0.0045),
        slope=(-0.03, 0.03),
    ),
    "wide": DynamicsRange(
        mass=(0.7, 1.3),
        com=(-0.08, 0.08),
        friction=(0.3, 1.3),
        damping=(0.3, 4.0),
        stiffness=(0.8, 1.2),
        strength=(0.8, 1.0),
        p_gain=(0.7, 1.3),
        d_gain=(0.7, 1.3),
        encoder_offset=(-0.03, 0.03),
        torque_delay=(0.0, 0.006),
        slope=(-0.1, 0.1),
    ),
}
"""What `walk.dynamics` can be besides "none"."""


def draw_dynamics(span: DynamicsRange, key: jax.Array, robots: int, physics_hz: float) -> tuple[Dynamics, jax.Array]:
    """What robots are like, [B], and the slope of the ground of each along x and y, [B, 2], rad."""
    shapes = {field.name: getattr(Dynamics.nominal(), field.name).shape for field in fields(Dynamics)} | {"slope": (2,)}
    keys = dict(zip(shapes, jax.random.split(key, len(shapes)), strict=True))

    def draw(name: str) -> jax.Array:
        low, high = getattr(span, name)
        return jax.random.uniform(keys[name], (robots, *shapes[name]), minval=low, maxval=high)

    drawn = {name: draw(name) for name in shapes}
    slope = drawn.pop("slope")
    drawn["torque_delay"] = jnp.round(drawn["torque_delay"] * physics_hz).astype(jnp.int32)
    return Dynamics(**drawn), slope


def vary(scenario: Scenario, span: DynamicsRange, key: jax.Array, physics_hz: float) -> Scenario:
    """The same with robots drawn anew, on ground that is a drawn slope steeper."""
    dynamics, slope = draw_dynamics(span, key, len(scenario.delay), physics_hz)
    ground = replace(scenario.ground, slope=scenario.ground.slope + slope)
    return replace(scenario, dynamics=dynamics, ground=ground)
