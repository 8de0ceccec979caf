"""Commands over time, as arrays and as people write them."""

import os
import re
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cassie_mjx.motion.command import JOYSTICK, JOYSTICK_MPS, STAND, Command
from cassie_mjx.robot.arrays import Array, namespace
from cassie_mjx.robot.cassie import CONTROL_PERIOD_S

LIMITS = np.array([JOYSTICK_MPS, *([-limit, limit] for limit in JOYSTICK)])
"""Least and greatest forward velocity, lateral velocity (m/s) and yaw rate (rad/s) of a command, [3, 2]."""
LONGEST_S = 3600.0
_NAMES = (("forward velocity", "m/s"), ("lateral velocity", "m/s"), ("yaw rate", "rad/s"))
_FORMS = (
    "a command such as 1.4, 0.7,0,0.5 or stand, commands at times such as '0:1,0,0 5:1,0,0.5 9:stand', or a file of "
    "such lines"
)


class CommandSchedule(NamedTuple):
    """What robots are commanded from when on."""

    starts: Array
    """Control step, since the schedule began, at which each target begins, [B, T], int32, rising from 0."""
    targets: Command
    """Leaves [B, T]."""

    @classmethod
    def of(cls, times_s: np.ndarray, commands: np.ndarray) -> "CommandSchedule":
        """Commands that begin at times.

        Args:
          times_s: [T] or [B, T], s, rising from 0; each begins at the first control step that is not before it.
          commands: the components of each `Command`, [B, T, 4]; or without the last, [B, T, 3], to walk.
        """
        starts = np.ceil(np.asarray(times_s) / CONTROL_PERIOD_S - 1e-9).astype(np.int32)
        numbers = np.zeros((*np.shape(commands)[:-1], len(Command._fields)), np.float32)
        numbers[..., : np.shape(commands)[-1]] = commands
        targets = Command(*np.moveaxis(numbers, -1, 0))
        return cls(np.broadcast_to(starts, targets.forward.shape), targets)

    def at(self, step: Array) -> Command:
        """The targets at control steps [B], leaves [B]."""
        xp = namespace(step, self.starts)
        begun = (xp.asarray(self.starts) <= step[:, None]).sum(axis=1, keepdims=True)
        return Command(*(xp.take_along_axis(xp.asarray(part), begun - 1, axis=1)[:, 0] for part in self.targets))

    def repeated(self, robots: int) -> "CommandSchedule":
        """The schedule of one robot for B = `robots` of them."""
        shape = robots, self.starts.shape[1]
        starts, *targets = (np.broadcast_to(part, shape) for part in (self.starts, *self.targets))
        return CommandSchedule(starts, Command(*targets))


def constant(*commands: tuple[float, ...]) -> CommandSchedule:
    """One command for each robot, (m/s, m/s, rad/s) or with `Command.stand`, for ever."""
    return CommandSchedule.of(np.zeros(1), np.array(commands)[:, None])


def parse_schedule(text: str) -> CommandSchedule:
    """The schedule of one robot that a text stands for.

    Args:
      text: a command, "0.7,0,0.5" (forward and lateral velocity, m/s, and yaw rate, rad/s), "1.4" (straight ahead) or
        "stand"; commands that begin at times, s, "0:1,0,0 5:1,0,0.5 9:stand"; or a file of these, one a line.

    Raises:
      ValueError: it stands for none, a number is out of range, or the times do not rise from 0.
    """
    entries = _content(text).split()
    if len(entries) == 1 and ":" not in entries[0]:
        entries = [f"0:{entries[0]}"]
    numbers = [_numbers(text, entry) for entry in entries]
    times = [time for time, _ in numbers]
    if not times or times[0] != 0:
        raise ValueError(f"command={text} must begin at 0 s, as in '0:1,0,0 5:1,0,0.5'.")
    for before, time in pairwise(times):
        if time <= before:
            raise ValueError(f"command={text} goes back in time, from {before:g} to {time:g} s; let its times rise.")
    return CommandSchedule.of(np.array(times), np.array([[command for _, command in numbers]]))


def _content(text: str) -> str:
    """A text of numbers as it is, and else what stands in the file of that name."""
    if re.fullmatch(rf"([-+.,:\d\s]|\b{STAND}\b)*", text):
        return text
    if not os.path.isfile(text):
        raise ValueError(f"command={text} is not known; give {_FORMS}.")
    try:
        return Path(text).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"command={text} cannot be read as a text; give {_FORMS}.") from error


def _numbers(text: str, entry: str) -> tuple[float, list[float]]:
    """Time, s, and the components of the command in an entry such as "5:1,0,0.5" of a text."""
    time, _, values = entry.partition(":")
    stands = values == STAND
    try:
        seconds, command = float(time), [0.0] if stands else [float(value) for value in values.split(",")]
    except ValueError:
        seconds, command = 0.0, []
    if len(command) not in (1, 3):
        raise ValueError(f"command={text} has {entry} in it; give {_FORMS}.")
    if not 0 <= seconds <= LONGEST_S:
        raise ValueError(f"command={text} has a time of {seconds:g} s; it must be from 0 to {LONGEST_S:g} s.")
    command += [0.0] * (3 - len(command))
    for (name, unit), number, (low, high) in zip(_NAMES, command, LIMITS.tolist(), strict=True):
        if not low <= number <= high:
            raise ValueError(
                f"command={text} has a {name} of {number:g} {unit}; it must be from {low:g} to {high:g} {unit}."
            )
    return seconds, [*command, float(stands)]
