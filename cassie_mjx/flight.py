"""Robots in the middle of their trials, and how time passes for them: the same on both engines.

On MuJoCo C a control step is a loop on the host; on MJX many control steps are one compiled call.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import numpy as np

from cassie_mjx import robot
from cassie_mjx.envs.disturbance import PUSH_S
from cassie_mjx.model import CONTROL_PERIOD_S, steps_per_control
from cassie_mjx.physics.mjx import MjxPhysics
from cassie_mjx.physics.types import Array, Disturbance, Physics, PhysicsState, delayed, merge, namespace
from cassie_mjx.trials import (
    SPEED_WINDOW_S,
    EpisodeResult,
    Subject,
    Trial,
    Walker,
    decide,
    disturbances,
    fallen,
    height_over_ground,
    placed,
)

# The motors' torque is sampled at least this often, in physics steps, also between the acts of a slow subject.
SAMPLE_STEPS = 8
# Control steps in one compiled call, about a second: few calls, and yet progress to show and room for the next trials.
COMPILED_CONTROL_STEPS = 31

T = TypeVar("T")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Record:
    """How each trial has gone so far; that of a trial which is over does not change any more.

    Attributes:
      seconds: duration of the trial, [B], s.
      trial_steps: control steps of the trial, [B].
      steps: control steps so far, [B].
      fell: whether the robot has fallen, [B], bool.
      lowest: smallest height of the pelvis over the ground below it, [B], m.
      height: sum of that height over control steps, [B], m.
      effort: sum of `motor_effort` over control steps, [B, 2], N·m and W.
      first: x and y of the pelvis at the start, [B, 2], m.
      late_x: x of the pelvis as the last 5 s begin, or now if they have not begun, [B], m.
      now: x and y of the pelvis now, [B, 2], m.
    """

    seconds: Array
    trial_steps: Array
    steps: Array
    fell: Array
    lowest: Array
    height: Array
    effort: Array
    first: Array
    late_x: Array
    now: Array

    @classmethod
    def begin(cls, qpos: np.ndarray, trials: Sequence[Trial]) -> "Record":
        """Nothing has happened yet to robots at qpos [B, 35]."""
        zero, xy = np.zeros(len(qpos)), qpos[:, :2].copy()
        return cls(
            seconds=np.array([trial.seconds for trial in trials]),
            trial_steps=np.array([trial.control_steps for trial in trials], np.int32),
            steps=np.zeros(len(qpos), np.int32),
            fell=np.zeros(len(qpos), bool),
            lowest=zero + np.inf,
            height=zero,
            effort=np.zeros((len(qpos), 2)),
            first=xy,
            late_x=xy[:, 0],
            now=xy,
        )

    @property
    def over(self) -> Array:
        """Whether the trial is over, [B]."""
        return self.fell | (self.steps >= self.trial_steps)

    @property
    def _window(self) -> Array:
        """Control steps over which the speed is taken."""
        return self.trial_steps.clip(0, round(SPEED_WINDOW_S / CONTROL_PERIOD_S))

    def update(self, qpos: Array, terrain: Array, effort: Array) -> "Record":
        """The record one control step on, which ended at qpos [B, 35] and took the mean `effort` [B, 2].

        A robot whose physics diverged in it has fallen; the rest of its record stays finite.
        """
        xp = namespace(qpos)
        diverged = ~(xp.isfinite(qpos).all(axis=1) & xp.isfinite(effort).all(axis=1))
        height = height_over_ground(qpos, terrain)
        counted = replace(self, steps=self.steps + 1, fell=fallen(qpos, terrain) | diverged)
        updated = replace(
            counted,
            lowest=xp.minimum(self.lowest, height),
            height=self.height + height,
            effort=self.effort + effort,
            late_x=xp.where(counted.steps <= self.trial_steps - self._window, qpos[:, 0], self.late_x),
            now=qpos[:, :2],
        )
        return merge(self.over, self, merge(diverged, counted, updated))

    def result(self) -> EpisodeResult:
        """What the trials that are over came to, [B], from a record of NumPy arrays; nothing for the others."""
        steps = np.maximum(self.steps, 1)
        torque, power = self.effort.T / steps
        distance, drift = (self.now - self.first).T
        return EpisodeResult(
            survived_s=np.minimum(self.steps * CONTROL_PERIOD_S, self.seconds),
            fell=self.fell,
            lowest_m=self.lowest,
            height_m=self.height / steps,
            speed_mps=(self.now[:, 0] - self.late_x) / (np.maximum(self._window, 1) * CONTROL_PERIOD_S),
            distance_m=distance,
            drift_m=drift,
            torque_nm=torque,
            power_w=power,
        )


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
    torque = robot.pd_torque(target, qpos[:, robot.ACTIVE_QPOS], qvel[:, robot.ACTIVE_QVEL], damping)
    power = (torque * state.qvel[:, robot.ACTIVE_QVEL]).clip(0)
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
