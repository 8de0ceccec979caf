"""How each trial has gone so far, and what it came to."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np

from cassie_mjx.envs.termination import has_fallen, height_over_ground
from cassie_mjx.evaluation.trial import EpisodeResult, Trial
from cassie_mjx.physics.types import PhysicsState, Scenario, merge, motor_torque
from cassie_mjx.robot import cassie
from cassie_mjx.robot.arrays import Array, namespace
from cassie_mjx.robot.cassie import CONTROL_PERIOD_S, PELVIS_POSITION, PELVIS_X

SPEED_WINDOW_S = 5.0


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrialRecord:
    """How each trial has gone so far; that of a trial which is over does not change any more.

    Attributes:
      seconds: duration of the trial, [B], s.
      trial_steps: control steps of the trial, [B].
      steps: control steps so far, [B].
      fell: whether the robot has fallen, [B], bool.
      lowest: smallest height of the pelvis over the ground below it, [B], m.
      height: sum of that height over control steps, [B], m.
      effort: sum of `motor_effort` over control steps, [B, 2], N·m and W.
      pending: the present control step's part of that sum, [B, 2].
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
    pending: Array
    first: Array
    late_x: Array
    now: Array

    @classmethod
    def begin(cls, qpos: np.ndarray, trials: Sequence[Trial]) -> "TrialRecord":
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
            pending=np.zeros((len(qpos), 2)),
            first=xy,
            late_x=xy[:, 0],
            now=xy,
        )

    @property
    def finished(self) -> Array:
        """Whether the trial is over, [B]."""
        return self.fell | (self.steps >= self.trial_steps)

    @property
    def _window(self) -> Array:
        """Control steps over which the speed is taken."""
        return self.trial_steps.clip(0, round(SPEED_WINDOW_S / CONTROL_PERIOD_S))

    def sample(self, state: PhysicsState, target: Array, scenario: Scenario, share: float) -> "TrialRecord":
        """See `simulate.Record.sample`."""
        return replace(self, pending=self.pending + share * motor_effort(state, target, scenario))

    def update(self, state: PhysicsState, scenario: Scenario) -> "TrialRecord":
        """See `simulate.Record.update`. A robot whose physics diverged has fallen; its record stays finite."""
        xp, qpos, effort = namespace(state.qpos), state.qpos, self.pending
        rested = replace(self, pending=xp.zeros_like(effort))
        diverged = ~(xp.isfinite(qpos).all(axis=1) & xp.isfinite(effort).all(axis=1))
        height = height_over_ground(qpos, scenario.ground)
        counted = replace(rested, steps=self.steps + 1, fell=has_fallen(height) | diverged)
        updated = replace(
            counted,
            lowest=xp.minimum(self.lowest, height),
            height=self.height + height,
            effort=self.effort + effort,
            late_x=xp.where(counted.steps <= self.trial_steps - self._window, qpos[:, PELVIS_X], self.late_x),
            now=qpos[:, PELVIS_POSITION[:2]],
        )
        return merge(self.finished, rested, merge(diverged, counted, updated))

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


def motor_effort(state: PhysicsState, target: Array, scenario: Scenario) -> Array:
    """What PD targets [B, 10] (rad) ask of the motors at the joints, [B, 2].

    Returns:
      Mean over motors of |torque|, N·m, and sum over motors of max(torque x velocity, 0), W.
    """
    torque = motor_torque(state, target, scenario)
    power = (torque * state.qvel[:, cassie.ACTIVE_QVEL]).clip(0)
    return namespace(state.qpos).stack([abs(torque).mean(axis=1), power.sum(axis=1)], axis=1)
