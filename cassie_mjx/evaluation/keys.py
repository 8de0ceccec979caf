"""The viewer's keys: which one commands what. MuJoCo's viewer has every letter in use already."""

import glfw
import numpy as np

from cassie_mjx.motion.command import Command
from cassie_mjx.motion.schedule import LIMITS

STEP = 0.1
"""What a key adds to a component of the command, m/s or rad/s."""
_STEPS = {
    glfw.KEY_UP: (STEP, 0.0, 0.0),
    glfw.KEY_DOWN: (-STEP, 0.0, 0.0),
    glfw.KEY_DELETE: (0.0, STEP, 0.0),
    glfw.KEY_PAGE_DOWN: (0.0, -STEP, 0.0),
    glfw.KEY_LEFT: (0.0, 0.0, STEP),
    glfw.KEY_RIGHT: (0.0, 0.0, -STEP),
}
STOP, RESET = glfw.KEY_END, glfw.KEY_HOME
STEERING = {STOP, *_STEPS}
PUSHES = {glfw.KEY_6: (1, 0), glfw.KEY_7: (-1, 0), glfw.KEY_8: (0, 1), glfw.KEY_9: (0, -1)}
"""Unit vectors (forward, left) of the pushes."""

STEERING_HELP = {
    "Up, Down": "faster, slower",
    "Left, Right": "turn",
    "Delete, Page Down": "left, right",
    "End": "stop; again: stand",
}
HELP = {"6, 7, 8, 9": "push forward, backward, left, right", "Home": "start anew"}
"""What the screen says of the keys of every agent."""


def steer(key: int, target: Command) -> Command:
    """The command of one robot that is the target after one of the keys `STEERING` was pressed.

    What a key changes comes to whole tenths within `motion.schedule.LIMITS`. Robots that are to stop are to stand if it
    is pressed again; any other key makes them walk.
    """
    *velocities, stand = target
    if key == STOP:
        return Command(0.0, 0.0, 0.0, max(stand, float(velocities == [0.0, 0.0, 0.0])))
    moved = [
        round(float(np.clip(now + step, low, high)), 1) if step else now
        for now, step, (low, high) in zip(velocities, _STEPS[key], LIMITS.tolist(), strict=True)
    ]
    return Command(*moved, stand=0.0)
