"""A walk to steer and to push about: `python -m cassie_mjx.view policy=any` opens MuJoCo's interactive viewer.

Keys steer a policy and push every agent (`evaluation.keys`). The pelvis is selected; dragging with Ctrl and the right
mouse button pushes it, a double click selects another part. A robot that has fallen starts anew, in steady walking.
"""

import time
import warnings
from collections import deque
from collections.abc import Iterator
from itertools import count

import glfw
import mujoco
import mujoco.viewer
import numpy as np

from cassie_mjx.agents.policy import PolicyAgent
from cassie_mjx.agents.steered import SteeredAgent
from cassie_mjx.agents.types import Agent
from cassie_mjx.envs.scenario import PUSH_S
from cassie_mjx.envs.termination import has_fallen, height_over_ground
from cassie_mjx.evaluation import keys
from cassie_mjx.evaluation.film import AFTER_FALL_S, begin
from cassie_mjx.evaluation.simulate import simulate
from cassie_mjx.evaluation.track import place_of, velocities
from cassie_mjx.evaluation.trial import Trial
from cassie_mjx.motion.command import Command
from cassie_mjx.motion.reference import mean_speed
from cassie_mjx.motion.schedule import constant
from cassie_mjx.physics.types import BodyState, Physics, PhysicsState, Scenario, begin_history
from cassie_mjx.robot import cassie
from cassie_mjx.robot.arrays import Array
from cassie_mjx.robot.drawing import load_scene
from cassie_mjx.robot.ground import FLAT, Terrain
from cassie_mjx.robot.model import servo_model
from cassie_mjx.robot.rotation import turned, yaw

# The viewer takes over state and mouse force so often.
SYNC_S = 0.016
SPEED_WINDOW_S = 1.0
PUSH_N = 50.0
"""Force of a push by a key, N."""


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
        return PhysicsState(qpos, qvel, warmstart, step, begin_history(qpos, qvel, self.max_delay))


def steerable(agent: Agent) -> Agent:
    """A policy that walks as one that follows commands, its own speed at first; any other agent as it is."""
    if not isinstance(agent, PolicyAgent) or mean_speed(agent.motion) == 0:
        return agent
    return SteeredAgent(agent, constant((float(mean_speed(agent.motion)), 0.0, 0.0)), agent.name)


class Live:
    """One robot that walks in one `MjData`, which steps as `NativePhysics` does while nobody touches it."""

    def __init__(self, agent: Agent, terrain: Terrain = FLAT) -> None:
        """Bring the robot up to speed.

        Args:
          agent: what walks.
          terrain: what it walks on.
        """
        self.agent, self.terrain = agent, terrain
        self.push_n = PUSH_N
        """Force of a push, N."""
        self.keys: deque[int] = deque()
        """Keys that were pressed and not answered yet, as GLFW numbers them; another thread may append to it."""
        kinematics, self._start = begin(agent, Trial(0, 0.0, terrain=terrain), 0.0)
        self.model = servo_model(load_scene(terrain.ground), agent.kd_scale)
        self.physics = LivePhysics(self.model, kinematics)
        self.data = self.physics.data
        self._scenario = Scenario.nominal(1, kd_scale=np.asarray(agent.kd_scale))
        self.restart()

    def restart(self) -> None:
        """Go back to the start."""
        self._robots = self._start._replace(physics=self.physics.take(self._start.physics))
        self.target: Command | None = None
        self._push_w, self._push_steps, self._down_s = np.zeros(3), 0, 0.0
        self.places = deque([self.place], round(SPEED_WINDOW_S / SYNC_S))
        """Where it was every 16 ms in the last second."""
        self._walk = simulate(self.agent, self.physics, self._robots, self._scenario, count(1), self._commands())

    def answer_keys(self) -> None:
        """Do what the keys say that were pressed."""
        while self.keys:
            key, command = self.keys.popleft(), self.command
            if key == keys.RESET:
                self.restart()
            elif key in keys.PUSHES:
                self.push(np.array(keys.PUSHES[key]))
            elif key in keys.STEERING and command is not None:
                self.target = keys.steer(key, self.target or command)

    def push(self, direction: np.ndarray) -> None:
        """Push the pelvis for 0.2 s in a direction (forward, left) of its heading frame."""
        heading = yaw(self.data.qpos[cassie.PELVIS_QUATERNION])
        self._push_w = self.push_n * np.append(turned(direction, heading), 0.0)
        self._push_steps = round(PUSH_S / self.model.opt.timestep)

    def advance(self, n_steps: int) -> None:
        """Advance by physics steps under the forces in `data.xfrc_applied` and those of pushes."""
        applied = self.data.xfrc_applied[cassie.PELVIS_BODY, :3]
        mouse, pushed = applied.copy(), min(self._push_steps, n_steps)
        for steps, force in ((pushed, mouse + self._push_w), (n_steps - pushed, mouse)):
            applied[:] = force
            for _ in range(steps):
                self._robots = next(self._walk).robots
        self._push_steps -= pushed

    def sync(self) -> None:
        """Do what the keys say and walk on for 16 ms. A robot that has fallen starts anew after a while."""
        self.answer_keys()
        self.advance(round(SYNC_S / self.model.opt.timestep))
        self._down_s = self._down_s + SYNC_S if self.fallen else 0.0
        if self._down_s >= AFTER_FALL_S:
            self.restart()
        self.places.append(self.place)

    @property
    def place(self) -> np.ndarray:
        """X and y, m, and heading, rad, of the pelvis in the world, [3]."""
        return place_of(self.data.qpos[None])[0]

    @property
    def command(self) -> Command | None:
        """What the policy is commanded now, in numbers; None for an agent that takes no commands."""
        if not isinstance(self.agent, SteeredAgent):
            return None
        return Command(*(float(part[0]) for part in self._robots.carry.command))

    @property
    def fallen(self) -> bool:
        """Whether the robot lies on the ground."""
        return bool(has_fallen(height_over_ground(self.data.qpos, self.terrain.ground)))

    def _commands(self) -> Iterator[Command | None]:
        """The targets of the keys, step by step of the agent; None for as long as none was pressed."""
        while True:
            target = self.target
            yield None if target is None else Command(*(np.full(1, part, np.float32) for part in target))


def keep_showing(viewer: mujoco.viewer.Handle, live: Live) -> None:
    """Walk in real time until the window is closed. The viewer writes the mouse's force into the robot's data."""
    due = time.perf_counter()
    while viewer.is_running():
        with viewer.lock():
            live.sync()
        viewer.set_texts(shown_text(live))
        viewer.sync()
        # A computer that is too slow shows slow motion and does not catch up.
        due = max(due + SYNC_S, time.perf_counter())
        time.sleep(max(due - time.perf_counter(), 0.0))


def shown_text(live: Live) -> tuple[None, None, str, str]:
    """What the screen says: time, target, command, velocity over the last second, and the keys; as MuJoCo takes it."""
    lines = {"time": f"{live.data.time:.1f} s"}
    if live.command is not None:
        lines |= {"target": _told(live.target or live.command), "command": _told(live.command)}
    lines["velocity"] = _told(Command(*velocities(np.array([live.places]), SYNC_S)[0].mean(axis=0)))
    lines |= ({} if live.command is None else keys.STEERING_HELP) | keys.HELP
    return None, None, "\n".join(lines), "\n".join(lines.values())


def _told(command: Command) -> str:
    # Adding 0 turns -0 into 0.
    forward, lateral, yaw_rate, stand = (round(float(part), 2) + 0.0 for part in command)
    if stand:
        return "stand"
    return f"{forward:.2f} m/s ahead, {lateral:.2f} m/s left, {yaw_rate:.2f} rad/s left"


def check_screen() -> None:
    """Raise ValueError where no window can be opened: the viewer's own thread would fail, and we wait for ever."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", glfw.GLFWError)
        if not glfw.init():
            raise ValueError(
                "The viewer needs a screen, and there is none here; python -m cassie_mjx.render films without one."
            )
