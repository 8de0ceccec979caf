"""What an agent is: whatever senses the robot's state and answers with PD targets."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np

from cassie_mjx.motion.command import Command
from cassie_mjx.motion.reference import ReferenceMotion
from cassie_mjx.physics.types import BodyState, Physics, PhysicsState, Scenario, sensed
from cassie_mjx.robot.arrays import Array

Carry: TypeAlias = Any
"""What an agent carries from step to step: a pytree whose leaves have the robots' axis B first."""


class Sensed(NamedTuple):
    """What agents are given of B robots."""

    qpos: Array
    """[B, 35], in MuJoCo's order."""
    qvel: Array
    """[B, 32]."""
    bodies: BodyState | None = None
    """Poses at (qpos, qvel), for agents that need them."""


class AgentState(NamedTuple):
    """B robots in the middle of a walk."""

    physics: PhysicsState
    carry: Carry


class Agent(Protocol):
    """Whatever walks: a policy, a blend of policies, the heuristic controller."""

    name: str
    period_s: float
    """Time between two steps, s: 0.032 or a whole fraction of it."""
    kd_scale: float
    """Factor on the D gains of the PD law that holds its targets."""
    needs_bodies: bool

    @property
    def motion(self) -> ReferenceMotion | None:
        """What it imitates; None for nothing."""
        ...

    @property
    def provenance(self) -> Mapping[str, Any]:
        """Where it came from; empty for what this package's code alone defines."""
        ...

    @property
    def lead(self) -> "Agent":
        """Who brings robots up to speed for it: itself, but for a blend."""
        ...

    @property
    def stride_acts(self) -> int:
        """Steps of the agent in one stride."""
        ...

    def acts_before(self, stride: int) -> int:
        """Steps from `init` to phase 0 of a stride."""
        ...

    def initial_state(self, robots: int) -> tuple[np.ndarray, np.ndarray]:
        """States (qpos [B, 35], qvel [B, 32]) that robots can begin to walk from."""
        ...

    def init(self, sensed: Sensed) -> Carry:
        """The carry of robots that begin to walk from what is sensed."""
        ...

    def step(self, carry: Carry, sensed: Sensed, command: Command | None) -> tuple[Array, Carry]:
        """PD targets [B, 10], rad, for what is sensed (old, if there is a delay), and the next carry.

        Without a command an agent walks as it does by itself.
        """
        ...

    def moved(self, carry: Carry, offset: np.ndarray) -> Carry:
        """The carry of robots that were carried by `offset` [B, 3], m, in the world."""
        ...

    def take_over(self, carry: Carry) -> Carry:
        """Its own carry for robots that its lead has brought up to speed."""
        ...


def sense(agent: Agent, physics: Physics, state: PhysicsState, scenario: Scenario) -> Sensed:
    """What the agent is given of robots in `state`: as it is sensed in their scenario."""
    qpos, qvel = sensed(state, scenario)
    bodies = physics.bodies(replace(state, qpos=qpos, qvel=qvel)) if agent.needs_bodies else None
    return Sensed(qpos, qvel, bodies)
