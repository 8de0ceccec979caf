"""A walk to push about in: `python -m cassie_mjx.view policy=1x` opens MuJoCo's interactive viewer.

The pelvis is selected; dragging with Ctrl and the right mouse button pushes it, a double click selects another part. A
robot that has fallen starts anew, in steady walking.
"""

import time
import warnings
from collections import deque

import glfw
import mujoco
import mujoco.viewer
import numpy as np

from cassie_mjx.evaluation.draw import load_scene
from cassie_mjx.evaluation.film import AFTER_FALL_S, begin
from cassie_mjx.evaluation.trial import Subject, Trial, Walker, decide, fallen
from cassie_mjx.physics.types import Disturbance, PhysicsState
from cassie_mjx.robot import cassie
from cassie_mjx.robot.model import servo_model

# The viewer takes over state and mouse force so often.
SYNC_S = 0.016
SPEED_WINDOW_S = 1.0


class Live:
    """One robot in one `MjData`, which steps as `NativePhysics` does while nobody touches it."""

    def __init__(self, subject: Subject, terrain: float = 0.0) -> None:
        """Bring the robot up to speed.

        Args:
          subject: what walks.
          terrain: height h of the terrain z = h sin x, m.
        """
        self.subject, self.terrain = subject, terrain
        self._physics, self._start = begin(subject, Trial(0, 0.0, terrain=terrain), 0.0)
        self.model = servo_model(load_scene(terrain), subject.damping)
        self.data = mujoco.MjData(self.model)
        self._act_steps = round(subject.period_s / self.model.opt.timestep)
        self.restart()

    def restart(self) -> None:
        """Go back to the start."""
        state, self._memory = self._start
        self._step = 0
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:] = state.qpos[0], state.qvel[0]
        self.data.qacc_warmstart[:] = state.qacc_warmstart[0]
        mujoco.mj_kinematics(self.model, self.data)

    def advance(self, n_steps: int) -> None:
        """Advance by physics steps under the forces in `data.xfrc_applied`."""
        for _ in range(n_steps):
            if self._step % self._act_steps == 0:
                self._act()
            mujoco.mj_step(self.model, self.data)
            self._step += 1

    @property
    def fallen(self) -> bool:
        """Whether the robot lies on the ground."""
        return bool(fallen(self.data.qpos[None], np.array([self.terrain]))[0])

    def _act(self) -> None:
        qpos, qvel, warmstart = (np.array([a]) for a in (self.data.qpos, self.data.qvel, self.data.qacc_warmstart))
        state = PhysicsState(qpos, qvel, warmstart, np.array([self._step]), np.zeros((1, 0, cassie.NQ + cassie.NV)))
        target, self._memory = decide(self.subject, self._physics, Walker(state, self._memory), Disturbance.none(1))
        self.data.ctrl[:] = target[0]


def run(viewer: mujoco.viewer.Handle, live: Live) -> None:
    """Walk in real time until the window is closed. The viewer writes the mouse's force into the robot's data."""
    steps = round(SYNC_S / live.model.opt.timestep)
    way, down_s = deque([float(live.data.qpos[0])], round(SPEED_WINDOW_S / SYNC_S)), 0.0
    due = time.perf_counter()
    while viewer.is_running():
        with viewer.lock():
            live.advance(steps)
            down_s = down_s + SYNC_S if live.fallen else 0.0
            if down_s >= AFTER_FALL_S:
                live.restart()
                way.clear()
        way.append(float(live.data.qpos[0]))
        speed = (way[-1] - way[0]) / (SYNC_S * max(len(way) - 1, 1))
        viewer.set_texts((None, None, "time\nspeed", f"{live.data.time:.1f} s\n{speed:.2f} m/s"))
        viewer.sync()
        # A computer that is too slow shows slow motion and does not catch up.
        due = max(due + SYNC_S, time.perf_counter())
        time.sleep(max(due - time.perf_counter(), 0.0))


def check_screen() -> None:
    """Raise ValueError where no window can be opened: the viewer's own thread would fail, and we wait for ever."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", glfw.GLFWError)
        if not glfw.init():
            raise ValueError(
                "The viewer needs a screen, and there is none here; python -m cassie_mjx.render films without one."
            )
