"""A policy that is steered: by a schedule of commands, by a follower of a path, or by whoever commands it live."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np

from cassie_mjx.agents.delegating import Delegating
from cassie_mjx.agents.policy import PolicyAgent
from cassie_mjx.agents.types import Sensed
from cassie_mjx.control.command import toward
from cassie_mjx.control.step import PolicyCarry
from cassie_mjx.motion.command import Command
from cassie_mjx.motion.reference import mean_speed
from cassie_mjx.motion.schedule import CommandSchedule, constant
from cassie_mjx.robot.arrays import Array


class Pilot(Protocol):
    """What steers robots: a pytree, leaves [B, ...], that returns the next of itself."""

    def target(self, sensed: Sensed) -> tuple[Command, "Pilot"]:
        """The commands that robots are to come to, leaves [B], and the pilot a control step later."""
        ...


class Scheduled(NamedTuple):
    """Robots that follow schedules."""

    schedule: CommandSchedule
    """Of each robot, leaves [B, T]."""
    step: Array
    """Control steps since it began, [B], int32."""

    @classmethod
    def begin(cls, schedule: CommandSchedule) -> "Scheduled":
        """At the start of schedules, leaves [B, T]."""
        return cls(schedule, np.zeros(len(schedule.starts), np.int32))

    def target(self, sensed: Sensed) -> tuple[Command, "Scheduled"]:
        """See `Pilot.target`."""
        return self.schedule.at(self.step), self._replace(step=self.step + 1)


class SteeredCarry(NamedTuple):
    """What a steered policy carries from step to step."""

    walk: PolicyCarry
    """Of the policy."""
    command: Command
    """What the policy was commanded last, leaves [B]."""
    pilot: Pilot
    """What steers; to steer robots otherwise, replace it."""


def steered_step(
    policy: PolicyAgent, carry: SteeredCarry, sensed: Sensed, command: Command | None
) -> tuple[Array, SteeredCarry]:
    """PD targets [B, 10], rad, under a command one step nearer to the target, and the next carry."""
    target, pilot = carry.pilot.target(sensed)
    goal = target if command is None else command
    told = toward(policy.motion, carry.command, goal, carry.walk.time, sensed.qvel)
    targets, walk = policy.step(carry.walk, sensed, told)
    return targets, SteeredCarry(walk, told, pilot)


class SteeredAgent(Delegating[PolicyAgent]):
    """A policy under commands, as an `Agent`.

    Its command goes at a limited pace (`control.command.toward`) to the target: that of the schedule, or the one that
    `step` is given. It brings robots up to speed straight ahead, at the forward velocity that the schedule begins with.
    """

    def __init__(
        self, policy: PolicyAgent, schedule: CommandSchedule, name: str, step: Callable[..., Any] | None = None
    ) -> None:
        """Take a policy, a schedule for one robot and a name.

        Args:
          policy: what walks.
          schedule: of one robot; all follow it unless their carry has another pilot.
          name: of the agent.
          step: `steered_step` of this policy, compiled; unless given, it is compiled.

        Raises:
          ValueError: the policy's reference has no speed that could be another.
        """
        if mean_speed(policy.motion) == 0:
            raise ValueError(f"policy={policy.name} steps on the spot; choose one that walks to command it.")
        super().__init__(name, policy)
        self.schedule = schedule
        self._step = jax.jit(partial(steered_step, policy)) if step is None else step

    @property
    def lead(self) -> "SteeredAgent":
        """See `Agent.lead`: the same policy, told to walk straight ahead as fast as the schedule's first command."""
        straight = constant((float(self.schedule.targets.forward[0, 0]), 0.0, 0.0))
        return SteeredAgent(self.inner, straight, self.inner.name, self._step)

    def init(self, sensed: Sensed) -> SteeredCarry:
        """See `Agent.init`: the command is the policy's own speed straight ahead."""
        robots = len(sensed.qpos)
        own = Command.ahead(np.full(robots, mean_speed(self.inner.motion), np.float32))
        return SteeredCarry(self.inner.init(sensed), own, Scheduled.begin(self.schedule.repeated(robots)))

    def step(self, carry: SteeredCarry, sensed: Sensed, command: Command | None) -> tuple[Array, SteeredCarry]:
        """See `Agent.step`: a command is the target in place of the schedule's."""
        return self._step(carry, sensed, command)

    def moved(self, carry: SteeredCarry, offset: np.ndarray) -> SteeredCarry:
        """See `Agent.moved`."""
        return carry._replace(walk=self.inner.moved(carry.walk, offset))

    def take_over(self, carry: SteeredCarry) -> SteeredCarry:
        """See `Agent.take_over`: the schedule begins."""
        return carry._replace(pilot=Scheduled.begin(self.schedule.repeated(len(carry.command.forward))))
