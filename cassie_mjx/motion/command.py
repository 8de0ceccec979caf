"""What a robot is commanded to do, as an array and as people write it."""

from typing import NamedTuple

from cassie_mjx.robot.arrays import Array, namespace

FASTEST = 4.0
"""Largest factor on the speed of the recorded stride (Xie et al. 2018): the legs cannot follow it beyond."""
SPEEDS = f"a factor from 0x to {FASTEST:g}x, such as 2x or 1.5x"


class Command(NamedTuple):
    """Commanded velocities of robots, in the frame of the path that they walk along."""

    forward: Array
    """[B], m/s; below 0 backwards."""
    lateral: Array
    """[B], m/s, to the left."""
    yaw_rate: Array
    """[B], rad/s, to the left."""
    stand: Array | float = 0.0
    """[B], from 0, to walk, to 1, to stand with both feet down."""

    @classmethod
    def ahead(cls, forward: Array) -> "Command":
        """Straight ahead at `forward` [B], m/s."""
        nothing = namespace(forward).zeros_like(forward)
        return cls(forward, nothing, nothing, nothing)

    @property
    def on_the_spot(self) -> Array:
        """Whether all velocities are 0, [B], bool."""
        return (self.forward == 0) & (self.lateral == 0) & (self.yaw_rate == 0)

    @property
    def steers(self) -> Array:
        """Whether the path lies where the robot is, for it turns, moves sideways or stands, [B], bool."""
        return (self.lateral != 0) | (self.yaw_rate != 0) | (self.stand != 0)


class Steering(NamedTuple):
    """How far training steers robots off straight ahead, either way."""

    lateral: float = 0.0
    """m/s."""
    yaw_rate: float = 0.0
    """rad/s."""


STRAIGHT = Steering()
JOYSTICK, JOYSTICK_MPS = Steering(0.4, 0.8), (-0.7, 2.8)
"""What `command=joystick` commands: the steering, and the range of forward speeds, m/s."""
FULL_STEERING_MPS, LEAST_STEERING = 2.1, 0.5
"""Forward speed up to which all of the steering is drawn, m/s, and the share of it at the highest speed."""
COMMANDS = ("speed", "joystick")
STAND = "stand"
"""The command to stand, as people write it."""


def speed_factor(speed: str, valid: str = SPEEDS) -> float:
    """The factor on the speed of the recorded stride that a text such as "2x" or "1.5" names.

    Raises:
      ValueError: it is not a number from 0 to 4, with or without an x; the message says that `valid` would work.
    """
    try:
        factor = float(speed.removesuffix("x"))
    except ValueError:
        factor = -1.0
    if not 0 <= factor <= FASTEST:
        raise ValueError(f"speed={speed} is not a speed; give {valid}.")
    return factor


def speed_factors(speed: str) -> tuple[float, tuple[float, float]]:
    """What a training's speed asks for: a factor on the motion, and the range of factors commanded on top.

    "2x" is 2 and (1, 1); "any" is 1 and (0, 4).

    Raises:
      ValueError: it is neither "any" nor a factor from 0 to 4.
    """
    if speed == "any":
        return 1.0, (0.0, FASTEST)
    return speed_factor(speed, f"{SPEEDS}, or any for all of them"), (1.0, 1.0)
