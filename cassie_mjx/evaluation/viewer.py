"""A walk to push about in: `python -m cassie_mjx.view policy=1x` opens MuJoCo's interactive viewer.

The pelvis is selected; dragging with Ctrl and the right mouse button pushes it, a double click selects another part. A
robot that has fallen starts anew, in steady walking.
"""

import time
import warnings
from collections import deque
from itertools import count

import glfw
import mujoco
import mujoco.viewer
import numpy as np

from cassie_mjx.agents.types import Agent
from cassie_mjx.envs.termination import has_fallen, height_over_ground
from cassie_mjx.evaluation.film import AFTER_FALL_S, begin
from cassie_mjx.evaluation.simulate import simulate
from cassie_mjx.evaluation.trial import Trial
from cassie_mjx.physics.types import BodyState, Physics, PhysicsState, Scenario
from cassie_mjx.robot import cassie
from cassie_mjx.robot.arrays import Array
from cassie_mjx.robot.drawing import load_scene
from cassie_mjx.robot.ground import FLAT, Terrain
from cassie_mjx.robot.model import servo_model

# The viewer takes over state and mouse force so often.
SYNC_S = 0.016
SPEED_WINDOW_S = 1.0


class LivePhysics:
    """An engine of one robot whose state is an `MjData`, so that others may look at it and push it meanwhile."""

    max_delay, traceable = 0, False

    def __init__(self, model: mujoco.MjModel, kinematics: Physics) -> None:
        """Take a model whose motors are position servos, and an engine for the poses of bodies."""
        self.model, self.data, self._kinematics = model, mujoco.MjData(model), kinematics

    def init(self, qpos: Array, qvel: Array) -> PhysicsState:
        """See `Physics.init`."""
        return self.take(self._kinematics.init(qpos, qvel))

    def take(self, state: PhysicsState) -> PhysicsState:
        """Begin anew from a state."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:] = state.qpos[0], state.qvel[0]
        self.data.qacc_warmstart[:] = state.qacc_warmstart[0]
        mujoco.mj_kinematics(self.model, self.data)
        return self._state(0 * state.step)

    def advance(self, state: PhysicsState, target: Array, scenario: Scenario, n_steps: int) -> PhysicsState:
        """See `Physics.advance`: from where the data are, under the forces in `data.xfrc_applied`."""
        self.data.ctrl[:] = target[0]
        mujoco.mj_step(self.model, self.data, n_steps)
        return self._state(state.step + n_steps)

    def bodies(self, state: PhysicsState) -> BodyState:
        """See `Physics.bodies`."""
        return self._kinematics.bodies(state)

    def _state(self, step: np.ndarray) -> PhysicsState:
        qpos, qvel, warmstart = (np.array([x]) for x in (self.data.qpos, self.data.qvel, self.data.qacc_warmstart))
        return PhysicsState(qpos, qvel, warmstart, step, np.zeros((1, 0, cassie.NQ + cassie.NV)))


class Live:
    """One robot that walks in one `MjData`, which steps as `NativePhysics` does while nobody touches it."""

    def __init__(self, agent: Agent, terrain: Terrain = FLAT) -> None:
        """Bring the robot up to speed.

        Args:
          agent: what walks.
          terrain: what it walks on.
        """
        self.agent, self.terrain = agent, terrain
        kinematics, self._start = begin(agent, Trial(0, 0.0, terrain=terrain), 0.0)
        self.model = servo_model(load_scene(terrain.ground), agent.kd_scale)
        self.physics = LivePhysics(self.model, kinematics)
        self.data = self.physics.data
        self._scenario = Scenario.nominal(1, kd_scale=np.asarray(agent.kd_scale))
        self.restart()

    def restart(self) -> None:
        """Go back to the start."""
        robots = self._start._replace(physics=self.physics.take(self._start.physics))
        self._walk = simulate(self.agent, self.physics, robots, self._scenario, count(1))

    def advance(self, n_steps: int) -> None:
        """Advance by physics steps under the forces in `data.xfrc_applied`."""
        for _ in range(n_steps):
            next(self._walk)

    @property
    def fallen(self) -> bool:
        """Whether the robot lies on the ground."""
        return bool(has_fallen(height_over_ground(self.data.qpos, self.terrain.ground)))


def keep_showing(viewer: mujoco.viewer.Handle, live: Live) -> None:
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
