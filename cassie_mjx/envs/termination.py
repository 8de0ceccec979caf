"""What ends an episode before its time, for NumPy and JAX arrays alike."""

from typing import NamedTuple

from cassie_mjx.robot import cassie
from cassie_mjx.robot.arrays import Array, namespace
from cassie_mjx.robot.ground import Ground, height_below


class Ends(NamedTuple):
    """Causes, each [B], bool. An episode can end by several: a robot whose state is NaN has fallen, too."""

    nan: Array
    """The physics diverged."""
    fallen: Array
    low_reward: Array
    position_error: Array
    """The robot is too far ahead of the reference motion or behind it, or, if it is steered, to the side of it."""


def height_over_ground(qpos: Array, ground: Ground) -> Array:
    """Height of the pelvis of qpos [..., 35] over the ground [...] below it, m."""
    return qpos[..., cassie.PELVIS_Z] - height_below(ground, qpos[..., cassie.PELVIS_X], qpos[..., cassie.PELVIS_Y])


def has_fallen(height: Array) -> Array:
    """Whether a pelvis is less than 0.6 m or more than 1.2 m over the ground (Xie et al. 2018), or NaN."""
    return ~((height >= cassie.FALL_LOW_M) & (height <= cassie.FALL_HIGH_M))


def ends(
    nan: Array, height: Array, reward: Array, away: Array, min_reward: float | None, max_position_error_m: float | None
) -> Ends:
    """Why episodes end now.

    Args:
      nan: whether a robot's state is not finite, [B].
      height: of the pelvis over the ground, [B], m.
      reward: of the last step, [B].
      away: how far the robot is from the reference motion, [B], m.
      min_reward: reward below which an episode ends; None for none.
      max_position_error_m: way from the reference beyond which an episode ends, m; None for none.
    """
    never = namespace(nan).zeros_like(nan)
    return Ends(
        nan,
        nan | has_fallen(height),
        never if min_reward is None else reward < min_reward,
        never if max_position_error_m is None else abs(away) > max_position_error_m,
    )


def fallen(qpos: Array, ground: Ground) -> Array:
    """Whether robots at qpos [..., 35] have fallen, on their ground, [...]."""
    return has_fallen(height_over_ground(qpos, ground))
