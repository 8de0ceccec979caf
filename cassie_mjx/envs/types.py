"""State of the walking task: pytrees with shape, unit and frame on every field (axis B: robots)."""

from dataclasses import dataclass
from typing import NamedTuple

import jax

from cassie_mjx.control.command import MotionState
from cassie_mjx.physics.types import PhysicsState, Scenario
from cassie_mjx.robot.arrays import Array


class StartOffset(NamedTuple):
    """How far off the reference motion robots begin."""

    velocity: Array
    """What the pelvis' velocity along x and y is on top of the reference's, [B, 2], m/s."""
    position: Array
    """How far ahead of the reference and to the left of it the pelvis is, [B, 2], m."""


class Start(NamedTuple):
    """The first moment of episodes."""

    qpos: Array
    """[B, 35]."""
    qvel: Array
    """[B, 32]."""
    motion: MotionState
    observation: Array
    """[B, O]."""
    sensing: Array
    """Carry of the observation, [B, H - 1, F]."""
    privileged: Array
    """[B, P]."""


class StepOutcome(NamedTuple):
    """What a control step led to, besides the physics of the robots that go on."""

    start: Start
    """Where the robots that ended begin anew."""
    scenario: Scenario
    push_level: Array
    motion: MotionState
    observation: Array
    final_observation: Array
    sensing: Array
    privileged: Array
    final_privileged: Array
    reward: Array
    terminated: Array
    truncated: Array
    metrics: dict[str, Array]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class WalkState:
    """B robots between two control steps; what a learner reads of an environment (`ppo.types.EnvState`).

    Attributes:
      physics: state of the engine.
      scenario: what differs from robot to robot.
      motion: where they are along the reference motion, and their commands.
      push_level: of the curriculum, [B], 0.1 to 1; 1 without one. Pushes, terrain, delay and commands follow it.
      sensing: what the observation carries from step to step, [B, H - 1, F]; empty without history.
      observation: what the policy acts on next, [B, O]; in a symmetric task as `ControlLaw.observe` gives it, in a
        mirror where the reference is in its second step, and so is the final one.
      final_observation: what the last step led to, before any reset, [B, O].
      privileged: what no robot senses but a critic may see, [B, P]: how far it is ahead of the reference motion, in
        units of 0.25 m, within +-10, how far its true state is from the reference's, where the policy does not observe
        it, what disturbs it, if anything does, and what it is like, if robots differ.
      final_privileged: the same before any reset, [B, P].
      reward: of the last step, [B], 0 to 1.
      terminated: the last step ended the episode by one of `termination.Ends`, [B], bool.
      truncated: the last step was the last of a full-length episode or of the motion, [B], bool.
      metrics: of the last step, each [B]: the unweighted reward terms, `plain` and `weighted` rewards, and 0 or 1 for
        each of `termination.Ends`.
    """

    physics: PhysicsState
    scenario: Scenario
    motion: MotionState
    push_level: Array
    sensing: Array
    observation: Array
    final_observation: Array
    privileged: Array
    final_privileged: Array
    reward: Array
    terminated: Array
    truncated: Array
    metrics: dict[str, Array]
