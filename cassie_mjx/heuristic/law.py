"""The heuristic controller that records the reference motion: a linear inverted pendulum, foot placement and PD loops.

The idea is that of Raibert (1986) with the capture-point algebra of Koolen et al. (2012): the stance leg carries the
body as an inverted pendulum, the swing foot lands where the next step ends at the wanted velocity, and a clock switches
the legs, steady unless a strong push makes it hurry. Every torque leaves as the PD target that makes the robot's own PD
law produce it.

Frames: `_w` is the world; all else is the heading frame, which has its origin at the pelvis and is turned about the
vertical by the pelvis' yaw, x forward, y left, z up. A side is 0 (left) or 1 (right).
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cassie_mjx.heuristic import pendulum
from cassie_mjx.heuristic.config import ControllerConfig
from cassie_mjx.heuristic.kinematics import (
    ANKLE_FROM_SOLE,
    ANKLE_HEIGHT,
    Sensed,
    inverse_kinematics,
    leg_jacobian,
    level_foot,
    sense,
    soles_w,
)
from cassie_mjx.heuristic.pendulum import Masses
from cassie_mjx.physics.types import BodyState
from cassie_mjx.robot import cassie
from cassie_mjx.robot.arrays import Array

SPRINGS = np.stack([cassie.qpos_index(f"left-{j}", f"right-{j}") for j in ("shin", "heel-spring")], axis=1)
# Shin and heel spring together bend by -0.128 rad under the whole weight on one leg, and by less than 5 % of that in
# swing.
FULL_DEFLECTION, NO_LOAD = -0.128, 0.05


@functools.partial(jax.tree_util.register_dataclass)
@dataclass(frozen=True)
class ControllerState:
    """What the controller carries from call to call.

    Attributes:
      phase: time on the clock since the legs last switched, [B], s; the clock runs in real time unless it hurries.
      stance: side of the stance leg, [B], int32.
      liftoff_w: midpoint of the swing foot's sole when it left the ground, [B, 3], m.
      line_w: line of walking: a point of it (x, y) in m, and its heading in rad, [B, 3].
    """

    phase: jax.Array
    stance: jax.Array
    liftoff_w: jax.Array
    line_w: jax.Array


def init(config: ControllerConfig, qpos: Array, bodies: BodyState) -> ControllerState:
    """Begin to walk from where the robot stands, the way it looks: half a step, on the right leg.

    Args:
      config: parameters.
      qpos: [B, 35], in MuJoCo's order.
      bodies: poses of the bodies at qpos.
    """
    return _over_robots(_init_robot, config, _float32((jnp.asarray(qpos), bodies)))


def step(
    config: ControllerConfig,
    masses: Masses,
    state: ControllerState,
    qpos: Array,
    qvel: Array,
    bodies: BodyState,
    dt: float,
) -> tuple[jax.Array, ControllerState]:
    """PD targets for the next `dt` seconds.

    Args:
      config: parameters.
      masses: of the robot.
      state: from `init` or the last `step`.
      qpos: [B, 35], in MuJoCo's order.
      qvel: [B, 32], in MuJoCo's order.
      bodies: poses and velocities of the bodies at (qpos, qvel).
      dt: time until the next call, s; a steady step then lasts round(step_time / dt) calls.

    Returns:
      PD targets of the ten active joints, [B, 10], rad, for the published gains `cassie.P_GAIN` and `cassie.D_GAIN`,
      and the next state.
    """
    robots = _float32((state, jnp.asarray(qpos), jnp.asarray(qvel), bodies))
    return _over_robots(functools.partial(_step_robot, masses=masses, dt=dt), config, robots)


def planned_velocity(config: ControllerConfig, height: jax.Array, side: jax.Array) -> jax.Array:
    """Velocity [2], m/s, of the centre of mass, `height` over the sole, as foot `side` lands in a steady walk."""
    omega = pendulum.rate(height)
    # The periodic gait of width W swaps +-v_0 each step: v_0 = sigma W/2 omega tanh(omega T / 2)
    v_0 = (1.0 - 2.0 * side) * config.width / 2 * omega * jnp.tanh(omega * config.step_time / 2)
    return jnp.stack([jnp.asarray(config.speed, jnp.float32), v_0])


def foot_placement(
    config: ControllerConfig, velocity: jax.Array, height: jax.Array, side: jax.Array, off_line: jax.Array
) -> jax.Array:
    """Where the swing foot should land, relative to the centre of mass at that moment.

    Args:
      config: parameters.
      velocity: v-, of the centre of mass at the end of this step, [2], m/s.
      height: h, of the centre of mass over the sole, m.
      side: the landing foot's side.
      off_line: lateral distance from the line of walking, m.

    Returns:
      Foothold (x, y), [2], m, not yet limited.
    """
    omega = pendulum.rate(height)
    cosh, sinh = jnp.cosh(omega * config.step_time), jnp.sinh(omega * config.step_time)
    expected = planned_velocity(config, height, side)
    back = jnp.clip(config.line_gain * off_line, -config.line_limit, config.line_limit)
    wanted = expected * jnp.array([1.0, -1.0]) - jnp.stack([jnp.zeros(()), back])
    gain = jnp.stack([jnp.asarray(config.gain_x), jnp.asarray(config.gain_y)])
    # From foothold f the next step ends at v_d = C v- - omega S f; K scales what v- differs from the plan:
    # f = (C v_plan - v_d) / (omega S) + K C / (omega S) (v- - v_plan)
    return (cosh * expected - wanted + gain * cosh * (velocity - expected)) / (omega * sinh)


def _pace(config: ControllerConfig, error: jax.Array) -> jax.Array:
    """Pace of the clock for an error [2] of the velocity at the end of the step: far off, the step ends sooner."""
    haste = jnp.linalg.norm(jnp.stack(config.haste) * error) - config.haste_free
    return 1 + jnp.clip(haste, 0.0, config.haste_limit)


def _landing(
    config: ControllerConfig, now: Sensed, state: ControllerState, r: jax.Array, v_end: jax.Array
) -> jax.Array:
    """Landing point (x, y) of the swing sole, within reach and outside the stance foot, [2], m."""
    swing = 1 - state.stance
    sigma = 1.0 - 2.0 * swing
    away, heading = now.pelvis_w[:2] - state.line_w[:2], state.line_w[2]
    off_line = jnp.cos(heading) * away[1] - jnp.sin(heading) * away[0]
    foothold = foot_placement(config, v_end, r[2], swing, off_line)
    inner = config.min_width - sigma * r[1]
    x = jnp.clip(foothold[0], -config.reach_x, config.reach_x)
    y = sigma * jnp.clip(sigma * foothold[1], inner, jnp.maximum(inner, config.reach_y))
    return now.com[:2] + jnp.stack([x, y])


def _swing_targets(
    config: ControllerConfig,
    now: Sensed,
    state: ControllerState,
    landing: jax.Array,
    pace: jax.Array,
    ahead: jax.Array,
) -> jax.Array:
    """Joint angles of the swing leg `ahead` seconds from now, [5], rad, if the pelvis keeps its velocity.

    The sole goes, level, from where it left the ground to `landing` (x, y), at the height of the ground expected there.
    """
    s = (state.phase + pace * ahead) / config.step_time
    start, stance = now.local(state.liftoff_w), now.soles[state.stance]
    stride = stance - start
    # dz / dx, and 0 instead of a large number for steps much shorter than 0.1 m
    slope = stride[2] * stride[0] / (stride[0] ** 2 + 0.1**2)
    ground = stance[2] + config.slope * slope * (landing[0] - stance[0])
    moved = now.velocity * ahead
    blend = (1 - jnp.cos(jnp.pi * jnp.minimum(config.hurry * s, 1.0))) / 2
    xy = (1 - blend) * (start[:2] - moved[:2]) + blend * landing
    lift = config.clearance * jnp.sin(jnp.pi * s) + (start[2] - ground) * jnp.maximum(1 - s / config.fade, 0.0)
    press = config.press * jnp.maximum(2 * s - 1, 0.0) ** 2
    sole = jnp.append(xy, ground - moved[2] + lift - press)
    ankle = now.tilt.T @ (sole + ANKLE_FROM_SOLE)
    hips_and_knee = inverse_kinematics(ankle, jnp.zeros(()), 1 - state.stance)
    return jnp.append(hips_and_knee, level_foot(hips_and_knee[2], now.angles[2]))


def _swing_torque(
    config: ControllerConfig, now: Sensed, state: ControllerState, landing: jax.Array, pace: jax.Array
) -> jax.Array:
    """Torque of the swing leg, [5], N·m: PD on its targets, whose velocity comes from their derivative."""
    plan = functools.partial(_swing_targets, config, now, state, landing, pace)
    target, target_rate = jax.jvp(plan, (jnp.zeros(()),), (jnp.ones(()),))
    swing = 1 - state.stance
    rate_error = config.swing_feedforward * target_rate - now.qdot[swing]
    return jnp.stack(config.swing_p) * (target - now.q[swing]) + jnp.stack(config.swing_d) * rate_error


def _stance_torque(
    config: ControllerConfig,
    now: Sensed,
    state: ControllerState,
    jacobian: jax.Array,
    mass: jax.Array,
    speed_error: jax.Array,
    swing_torque: jax.Array,
    weight: jax.Array,
) -> jax.Array:
    """Torque of the stance leg, [5], N·m: it holds the pelvis' attitude and height and carries the body.

    `weight` goes from 0, landing, to 1, standing.
    """
    side = state.stance
    q, qdot = now.q[side], now.qdot[side]
    # The ground pushes along the pendulum: F = m g r / h; tau = -J F
    r = now.com - now.soles[side]
    gravity = -jacobian @ (mass * pendulum.GRAVITY * r / r[2])
    # The pitch joint's axis points to the right, against the pelvis' pitch: hence its signs.
    turn = now.angles[1] - state.line_w[2]
    turn = jnp.arctan2(jnp.sin(turn), jnp.cos(turn))
    error = jnp.stack([now.angles[0], turn, config.lean - now.angles[2]])
    attitude = jnp.stack(config.body_p) * error + jnp.stack(config.body_d) * now.rates * jnp.array([1.0, 1.0, -1.0])
    carrying = gravity[:3] + attitude - jnp.stack(config.reaction) * swing_torque[:3]
    landing = -config.hold * jnp.stack(config.swing_d[:3]) * qdot[:3]
    ankle = now.ankles[side].at[2].set(ANKLE_HEIGHT - config.height)
    knee_target = inverse_kinematics(now.tilt.T @ ankle, q[1], side)[3]
    knee = config.knee_p * (knee_target - q[3]) - config.knee_d * qdot[3] + weight * gravity[3]
    lever = jnp.clip(config.foot_gain * speed_error, -config.foot_limit, config.foot_limit)
    foot = weight * lever - config.foot_d * qdot[4]
    return jnp.concatenate([weight * carrying + (1 - weight) * landing, jnp.stack([knee, foot])])


def _stance_weight(config: ControllerConfig, state: ControllerState, qpos: jax.Array) -> jax.Array:
    """How far the stance leg has taken over, 0 to 1: by the clock, and only while its springs feel the ground."""
    load = qpos[SPRINGS][state.stance].sum() / FULL_DEFLECTION
    return jnp.clip(state.phase / config.ramp, 0, 1) * jnp.clip((load - NO_LOAD) / config.load, 0, 1)


def _switch(config: ControllerConfig, state: ControllerState, bodies: BodyState, dt: float) -> ControllerState:
    """Exchange the legs when the step's time is up, to the nearest call."""
    over = state.phase >= config.step_time - dt / 2
    stance = jnp.where(over, 1 - state.stance, state.stance)
    liftoff_w = jnp.where(over, soles_w(bodies)[1 - stance], state.liftoff_w)
    return ControllerState(jnp.where(over, 0.0, state.phase), stance, liftoff_w, state.line_w)


def _step_robot(
    config: ControllerConfig,
    robot_now: tuple[ControllerState, jax.Array, jax.Array, BodyState],
    masses: Masses,
    dt: float,
) -> tuple[jax.Array, ControllerState]:
    """`step` for one robot: the same arrays without the axis B."""
    state, qpos, qvel, bodies = robot_now
    state = _switch(config, state, bodies, dt)
    now = sense(qpos, qvel, bodies)
    pivot = now.soles[state.stance]
    r = now.com - pivot
    velocity, remaining = pendulum.velocity(masses, bodies, now, pivot), config.step_time - state.phase
    planned = planned_velocity(config, r[2], 1 - state.stance)
    pace = _pace(config, pendulum.velocity_after(r, velocity, remaining) - planned)
    v_end = pendulum.velocity_after(r, velocity, remaining / pace)
    swing = _swing_torque(config, now, state, _landing(config, now, state, r, v_end), pace)
    jacobian = leg_jacobian(bodies, now, state.stance)
    weight = _stance_weight(config, state, qpos)
    stance = _stance_torque(config, now, state, jacobian, masses.mass.sum(), v_end[0] - config.speed, swing, weight)
    torque = jnp.where(jnp.arange(2)[:, None] == state.stance, stance, swing)
    target = cassie.torque_as_target(torque.ravel(), now.q.ravel(), now.qdot.ravel())
    return target.astype(jnp.float32), replace(state, phase=state.phase + pace * dt)


def _init_robot(config: ControllerConfig, robot_now: tuple[jax.Array, BodyState]) -> ControllerState:
    """`init` for one robot."""
    qpos, bodies = robot_now
    pelvis = bodies.xmat[cassie.PELVIS_BODY]
    return ControllerState(
        phase=jnp.asarray(config.step_time / 2, jnp.float32),
        stance=jnp.ones((), jnp.int32),
        liftoff_w=soles_w(bodies)[0],
        line_w=jnp.stack([qpos[0], qpos[1], jnp.arctan2(pelvis[1, 0], pelvis[0, 0])]),
    )


def _over_robots(function: Callable, config: ControllerConfig, robots: Any) -> Any:
    """Map `function(config, robot)` over the robots' leading axis, and over that of every config leaf that has one."""
    axes = jax.tree.map(lambda leaf: 0 if jnp.ndim(leaf) else None, config)
    return jax.vmap(function, in_axes=(axes, 0))(config, robots)


def _float32(tree: Any) -> Any:
    """Physics in double precision is welcome; the law itself is float32 everywhere."""
    return jax.tree.map(lambda x: x.astype(jnp.float32) if jnp.issubdtype(x.dtype, jnp.floating) else x, tree)
