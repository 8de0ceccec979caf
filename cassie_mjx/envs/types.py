"""State of the walking task: pytrees with shape, unit and frame on every field (axis B: robots)."""

from dataclasses import dataclass

import jax

from cassie_mjx.physics.types import Array, Disturbance, PhysicsState


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Clock:
    """Where each robot is along the reference motion and in its episode.

    Attributes:
      phase: sample of the stride, [B], int32, 0 to N - 1.
      stride: strides since the start of the episode, [B], int32.
      step: control steps since the start of the episode, [B], int32.
      speed: factor on the motion's speed along x at present, which robots are told, [B].
      command: the factor that `speed` moves to; no robot senses it, [B].
      origin_x: world x of the point where the motion's x is 0, [B], m.
    """

    phase: Array
    stride: Array
    step: Array
    speed: Array
    command: Array
    origin_x: Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class WalkState:
    """B robots between two control steps; what a learner reads of an environment (`ppo.types.EnvState`).

    Attributes:
      physics: state of the engine.
      disturbance: what acts on the robots besides their motors.
      clock: where they are along the reference motion.
      observation: what the policy acts on next, [B, 80]; in a symmetric task `observation.folded`, and so is the final
        one.
      final_observation: what the last step led to, before any reset, [B, 80].
      privileged: what no robot senses but a critic may see, [B, 1]: how far it is ahead of the reference motion, in
        units of 0.25 m, within +-10.
      final_privileged: the same before any reset, [B, 1].
      reward: of the last step, [B], 0 to 1.
      terminated: the last step ended the episode in a fall, a NaN, too low a reward or too far from the
        reference, [B], bool.
      truncated: the last step was the last of a full-length episode, [B], bool.
      metrics: of the last step, each [B]: the unweighted reward terms, `plain` and `weighted` rewards, and 0 or 1 for
        each of `walk.ENDS`.
    """

    physics: PhysicsState
    disturbance: Disturbance
    clock: Clock
    observation: Array
    final_observation: Array
    privileged: Array
    final_privileged: Array
    reward: Array
    terminated: Array
    truncated: Array
    metrics: dict[str, Array]
