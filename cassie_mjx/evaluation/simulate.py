"""Robots in the middle of their trials, and how time passes for them: the same on both engines.

On MuJoCo C a control step is a loop on the host; on MJX many control steps are one compiled call.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import numpy as np

from cassie_mjx.envs.scenario import PUSH_S
from cassie_mjx.evaluation.record import Record
from cassie_mjx.evaluation.trial import Subject, Trial, Walker, decide, disturbances, placed
from cassie_mjx.physics.mjx import MjxPhysics
from cassie_mjx.physics.types import Array, Disturbance, Physics, PhysicsState, delayed, namespace
from cassie_mjx.robot import cassie
from cassie_mjx.robot.model import steps_per_control

# The motors' torque is sampled at least this often, in physics steps, also between the acts of a slow subject.
SAMPLE_STEPS = 8
# Control steps in one compiled call, about a second: few calls, and yet progress to show and room for the next trials.
COMPILED_CONTROL_STEPS = 31

T = TypeVar("T")


class Flight(NamedTuple):
    """B robots, what disturbs them, and how they have done so far."""

    walker: Walker
    disturbance: Disturbance
    record: Record


def begin(subject: Subject, physics: Physics, starts: Walker, trials: Sequence[Trial]) -> Flight:
    """Robots [B] about to begin these trials; arguments as in `sweeps.conduct`.

    Raises:
      ValueError: the engine's PD law is not the subject's.
    """
    if subject.damping != physics.damping:
        raise ValueError(
            f"{subject.name} walks with damping={subject.damping:g}, this engine has {physics.damping:g}; "
            "make it with the subject's."
        )
    walker = placed(subject, starts, trials)
    disturbance = disturbances(trials, walker.physics, round(PUSH_S / physics.model.opt.timestep))
    return Flight(walker, disturbance, Record.begin(walker.physics.qpos, trials))


def advance(subject: Subject, physics: Physics, flight: Flight) -> Flight:
    """Let time pass for all robots: a control step on MuJoCo C; on MJX a compiled call of 31, or until all are over.

    Raises:
      ValueError: the subject's period does not divide the control step into whole physics steps.
    """
    step = _compiled_steps if isinstance(physics, MjxPhysics) else control_step
    return step(subject, physics, flight)


@partial(jax.jit, static_argnums=(0, 1))
def _compiled_steps(subject: Subject, physics: Physics, flight: Flight) -> Flight:
    def going_on(carry: tuple[Array, Flight]) -> Array:
        steps, flight = carry
        return (steps < COMPILED_CONTROL_STEPS) & ~flight.record.over.all()

    def step(carry: tuple[Array, Flight]) -> tuple[Array, Flight]:
        steps, flight = carry
        return steps + 1, control_step(subject, physics, flight)

    return jax.lax.while_loop(going_on, step, (0, flight))[1]


def control_step(subject: Subject, physics: Physics, flight: Flight) -> Flight:
    """All robots 32 ms later, also those whose trial is over: only their record stands still."""
    walker, disturbance, record = flight
    act_steps, acts = _rhythm(subject, physics)
    chunk = math.gcd(act_steps, SAMPLE_STEPS)

    def act(carry: tuple[Walker, Array]) -> tuple[Walker, Array]:
        walker, effort = carry
        target, memory = decide(subject, physics, walker, disturbance)

        def move(carry: tuple[PhysicsState, Array]) -> tuple[PhysicsState, Array]:
            state = physics.advance(carry[0], target, disturbance, chunk)
            return state, carry[1] + motor_effort(state, target, disturbance, physics.damping)

        state, effort = _repeat(act_steps // chunk, move, (walker.physics, effort))
        return Walker(state, memory), effort

    walker, effort = _repeat(acts, act, (walker, namespace(record.effort).zeros_like(record.effort)))
    effort = effort * (chunk / (acts * act_steps))
    return Flight(walker, disturbance, record.update(walker.physics.qpos, disturbance.terrain, effort))


def motor_effort(state: PhysicsState, target: Array, disturbance: Disturbance, damping: float) -> Array:
    """What PD targets [B, 10] (rad) ask of the motors at the joints, [B, 2]; `damping` is the PD law's.

    Returns:
      Mean over motors of |torque|, N·m, and sum over motors of max(torque x velocity, 0), W.
    """
    qpos, qvel = delayed(state, disturbance)
    torque = cassie.pd_torque(target, qpos[:, cassie.ACTIVE_QPOS], qvel[:, cassie.ACTIVE_QVEL], damping)
    power = (torque * state.qvel[:, cassie.ACTIVE_QVEL]).clip(0)
    return namespace(state.qpos).stack([abs(torque).mean(axis=1), power.sum(axis=1)], axis=1)


def _rhythm(subject: Subject, physics: Physics) -> tuple[int, int]:
    """Physics steps from act to act, and acts in a control step."""
    hertz = 1 / physics.model.opt.timestep
    act_steps = round(subject.period_s * hertz)
    acts, rest = divmod(steps_per_control(hertz), max(act_steps, 1))
    if rest or not acts:
        raise ValueError(f"{subject.name} acts every {subject.period_s:g} s, which does not divide 0.032 s.")
    return act_steps, acts


def _repeat(times: int, step: Callable[[T], T], carry: T) -> T:
    """`step` again and again: a loop of Python's on NumPy arrays (the first leaf tells), of XLA's on JAX arrays."""
    if isinstance(jax.tree.leaves(carry)[0], np.ndarray):
        for _ in range(times):
            carry = step(carry)
        return carry
    return jax.lax.fori_loop(0, times, lambda _, carry: step(carry), carry)
