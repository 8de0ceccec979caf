"""A chain of policies that walk as one."""

from collections.abc import Sequence
from dataclasses import replace

import jax
import numpy as np

from cassie_mjx.agents import blending
from cassie_mjx.agents.blending import SCHEDULES, Progress
from cassie_mjx.agents.policy import PolicyAgent
from cassie_mjx.evaluation.trial import Measured, Walker
from cassie_mjx.physics.types import Array, Physics, PhysicsState
from cassie_mjx.robot.model import CONTROL_PERIOD_S

BLEND_PREFIX = "blend:"


class BlendAgent:
    """A chain of policies, blended as a schedule says, as a `Subject`; it starts in the first policy's walk."""

    period_s = CONTROL_PERIOD_S

    def __init__(self, policies: Sequence[PolicyAgent], schedule: str) -> None:
        """Take policies and the name of one of `SCHEDULES`.

        Raises:
          ValueError: the policies cannot be blended, or not by this schedule, or it is not known.
        """
        self.policies, self.motions = policies, [policy.motion for policy in policies]
        self.speeds = [blending.mean_speed(motion) for motion in self.motions]
        self.name = f"{BLEND_PREFIX}{','.join(policy.name for policy in policies)} schedule={schedule}"
        self.provenance = {policy.name: policy.provenance for policy in policies}
        blending.check_chain(self.motions)
        self.damping = policies[0].damping
        if any(policy.damping != self.damping for policy in policies):
            raise ValueError(f"{self.name}: its policies have D gains of their own, so that no one PD law holds both.")
        if schedule not in SCHEDULES:
            raise ValueError(f"schedule={schedule} is not known; choose one of {', '.join(SCHEDULES)}.")
        if schedule == "adaptive" and (np.diff(self.speeds) <= 0).any():
            raise ValueError(f"{self.name} goes by speed; name its policies from the slowest to the fastest.")
        self._schedule = SCHEDULES[schedule]
        self._act = jax.jit(self._blended)

    def start(self, physics: Physics, phases: np.ndarray) -> Walker:
        """See `Subject.start`."""
        state, phase = self.policies[0].start(physics, phases)
        return Walker(state, Progress(phase, 0 * phase, np.full(len(phase), self.speeds[0], np.float32)))

    def returns(self, physics: Physics, delay: int = 0) -> list[Measured]:
        """See `Subject.returns`: a blend imitates no one motion, so it has none."""
        return []

    def act(self, physics: Physics, seen: PhysicsState, memory: Progress) -> tuple[Array, Progress]:
        """See `Subject.act`."""
        return self._act(seen.qpos, seen.qvel, memory)

    def carried(self, memory: Progress, offset: np.ndarray) -> Progress:
        """See `Subject.carried`: a blend remembers no place."""
        return memory

    def position(self, memory: Progress) -> Array:
        """Where along the chain robots are, [B], 0 for the first policy."""
        return self._schedule(memory, self.speeds)

    def _blended(self, qpos: Array, qvel: Array, memory: Progress) -> tuple[Array, Progress]:
        memory = replace(memory, speed=blending.filtered(memory.speed, qvel[:, 0]))
        ahead = memory.phase + 1
        modes = [policy.mode for policy in self.policies]
        target = blending.pd_target(modes, self.motions, self.position(memory), ahead, qpos, qvel)
        return target, replace(memory, phase=ahead % len(self.motions[0].qpos), step=memory.step + 1)
