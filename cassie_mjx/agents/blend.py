"""A chain of policies that walk as one."""

from collections.abc import Sequence
from dataclasses import replace

import jax
import numpy as np

from cassie_mjx.agents import blending
from cassie_mjx.agents.blending import SCHEDULES, Progress
from cassie_mjx.agents.delegating import Delegating
from cassie_mjx.agents.policy import PolicyAgent
from cassie_mjx.agents.types import Sensed
from cassie_mjx.control.network import start
from cassie_mjx.control.observation import Seen
from cassie_mjx.control.step import PolicyCarry
from cassie_mjx.motion.command import Command
from cassie_mjx.motion.reference import mean_speed, sample
from cassie_mjx.robot import cassie
from cassie_mjx.robot.arrays import Array

BLEND_PREFIX = "blend:"


class BlendAgent(Delegating[PolicyAgent]):
    """A chain of policies, blended as a schedule says, as an `Agent`; it starts in the first policy's walk."""

    def __init__(self, policies: Sequence[PolicyAgent], schedule: str) -> None:
        """Take policies and the name of one of `SCHEDULES`.

        Raises:
          ValueError: the policies cannot be blended, or not by this schedule, or it is not known.
        """
        self.policies, self.motions = policies, [policy.motion for policy in policies]
        self.speeds = [float(mean_speed(motion)) for motion in self.motions]
        blending.check_chain(self.motions)
        name = f"{BLEND_PREFIX}{','.join(policy.name for policy in policies)} schedule={schedule}"
        super().__init__(name, policies[0])
        self.motion, self.provenance = None, {policy.name: policy.provenance for policy in policies}
        if any(policy.kd_scale != self.kd_scale for policy in policies):
            raise ValueError(f"{self.name}: its policies have D gains of their own, so that no one PD law holds both.")
        if schedule not in SCHEDULES:
            raise ValueError(f"schedule={schedule} is not known; choose one of {', '.join(SCHEDULES)}.")
        if schedule == "adaptive" and (np.diff(self.speeds) <= 0).any():
            raise ValueError(f"{self.name} goes by speed; name its policies from the slowest to the fastest.")
        self._schedule = SCHEDULES[schedule]
        self._step = jax.jit(self._blended)

    def init(self, sensed: Sensed) -> Progress:
        """See `Agent.init`."""
        zeros = np.zeros(len(sensed.qpos), np.int32)
        laws = tuple(policy.init(sensed).law for policy in self.policies)
        return Progress(zeros, zeros, np.full(len(zeros), self.speeds[0], np.float32), laws)

    def step(self, carry: Progress, sensed: Sensed, command: Command | None) -> tuple[Array, Progress]:
        """See `Agent.step`: its speed is the schedule's."""
        return self._step(carry, sensed)

    def moved(self, carry: Progress, offset: np.ndarray) -> Progress:
        """See `Agent.moved`: a blend remembers no place."""
        return carry

    def take_over(self, carry: PolicyCarry) -> Progress:
        """See `Agent.take_over`: every policy has sensed what the first one has, whose network alone remembers it."""
        robots = len(carry.time)
        speed = np.full(robots, self.speeds[0], np.float32)
        others = (carry.law._replace(hidden=start(policy.network, robots)) for policy in self.policies[1:])
        return Progress(carry.time, 0 * carry.time, speed, (carry.law, *others))

    def position(self, carry: Progress) -> Array:
        """Where along the chain robots are, [B], 0 for the first policy."""
        return self._schedule(carry, self.speeds)

    def _blended(self, carry: Progress, sensed: Sensed) -> tuple[Array, Progress]:
        forward = sensed.qvel[:, cassie.PELVIS_VELOCITY[0]]
        carry = replace(carry, speed=blending.filtered(carry.speed, forward))
        ahead = carry.phase + 1
        residuals, laws = [], []
        for policy, own in zip(self.policies, carry.laws, strict=True):
            seen = Seen(sensed.qpos, sensed.qvel, *sample(policy.motion, ahead))
            residual, own = policy.law.act(policy.network, own, seen)
            residuals.append(residual)
            laws.append(own)
        target = blending.pd_target(residuals, self.motions, self.position(carry), ahead)
        phase = ahead % self.stride_acts
        return target, replace(carry, phase=phase, step=carry.step + 1, laws=tuple(laws))
