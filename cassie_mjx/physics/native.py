"""MuJoCo C: a batch of robots on all cores; every headline figure is measured on it, at 2 kHz."""

import copy
import os
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from operator import itemgetter

import jax
import mujoco
import numpy as np
from mujoco.batch import Batch

from cassie_mjx.physics.memory import begin_memory, late_torque, remembered, rhythm
from cassie_mjx.physics.types import (
    BodyState,
    PhysicsState,
    Scenario,
    check_batch,
    check_delay,
    check_ground,
    check_start,
    motor_torque,
)
from cassie_mjx.robot import cassie
from cassie_mjx.robot.arrays import Array
from cassie_mjx.robot.dynamics import Dynamics, set_dynamics
from cassie_mjx.robot.ground import Ground, scene_of, set_terrain
from cassie_mjx.robot.model import servo_model


def cores() -> int:
    """Cores that this process may use: what the machine has, or what a scheduler or `taskset` leaves it of them."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


MOST_MODELS = 256
"""Models that an engine keeps beyond those in use: training comes back to the same grounds again and again. One with
rough ground has 2 MB."""


class NativePhysics:
    """Steps robots with `mujoco.batch` on a pool of threads; implements `Physics` on NumPy float64 arrays.

    Without delay the motors are position servos, so that a whole control step is one call into C. With delay the PD law
    runs here, on the delayed joint states, and the motors take its torque step by step. Not for several Python threads
    at once.
    """

    traceable = False

    def __init__(self, model: mujoco.MjModel, max_delay: int = 0, threads: int = 0, electronics: bool = False) -> None:
        """Make the engine of one model.

        Args:
          model: from `robot.model.load_model`; only its terrain and rough scenes have a
            `Scenario.ground` that is not flat.
          max_delay: longest delay that a scenario will ask for, physics steps; 0 for the faster path.
          threads: size of the pool; 0 for all `cores`.
          electronics: whether encoders, filters and motors are the robot's; `max_delay` has room for their delay then.

        Raises:
          ValueError: the electronics have no whole number of cycles in a physics step, or `max_delay` no room for them.
        """
        self.model = model
        self._rhythm = rhythm(model, electronics, max_delay)
        self.max_delay = max_delay
        self._threads = threads or cores()
        self._scene = scene_of(model)
        self._scratch = mujoco.MjData(model)
        self._models: dict[bytes, mujoco.MjModel] = {}
        self._batches: dict[int, _Pool] = {}
        self._kinematics: dict[int, _Kinematics] = {}

    def init(self, qpos: Array, qvel: Array) -> PhysicsState:
        """See `Physics.init`."""
        qpos, qvel = np.array(qpos, float), np.array(qvel, float)
        check_start(qpos, qvel)
        history, memory = begin_memory(qpos, qvel, self.max_delay, self._rhythm)
        return PhysicsState(qpos, qvel, np.zeros_like(qvel), np.zeros(len(qpos), np.int32), history, memory)

    def advance(self, state: PhysicsState, target: Array, scenario: Scenario, n_steps: int) -> PhysicsState:
        """See `Physics.advance`."""
        check_batch(state, target, scenario)
        check_delay(scenario, self.max_delay)
        check_ground(scenario, self._scene)
        pool = self._load(state, scenario)
        if not self.max_delay:
            pool.ctrl[:] = target
            for start, stop in _force_segments(state.step, scenario, n_steps):
                pool.push[:] = scenario.force(state.step + start)
                pool.batch.step(nstep=stop - start)
            return pool.state(state.step + n_steps, state.history)
        state = replace(state, history=state.history.copy())
        for _ in range(n_steps):
            torque = motor_torque(state, target, scenario)
            pool.ctrl[:] = late_torque(state, torque, scenario, self._rhythm.torque_delay) / cassie.GEAR
            pool.push[:] = scenario.force(state.step)
            pool.batch.step()
            after = pool.state(state.step + 1, state.history)
            row, memory = remembered(state, after.qpos, after.qvel, torque, self._rhythm)
            state = replace(after, electronics=memory)
            state.history[np.arange(len(row)), state.step % (self.max_delay + 1)] = row
        return state

    def bodies(self, state: PhysicsState) -> BodyState:
        """See `Physics.bodies`."""
        batch_size = len(state.qpos)
        if batch_size not in self._kinematics:
            self._kinematics[batch_size] = _Kinematics(Batch(self.model, batch_size, self._threads))
        return self._kinematics[batch_size](state)

    def _load(self, state: PhysicsState, scenario: Scenario) -> "_Pool":
        """The pool of as many robots, with their models and states."""
        batch_size = len(state.qpos)
        if batch_size not in self._batches:
            self._batches[batch_size] = _Pool(Batch(self.model, batch_size, self._threads))
        pool = self._batches[batch_size]
        # Robots whose rows are the same share a model.
        parameters = np.column_stack(jax.tree.leaves(_of_models(scenario)))
        if not np.array_equal(pool.parameters, parameters):
            pool.parameters = parameters
            rows = [row.tobytes() for row in parameters]
            self._make_models(scenario, {row: robot for robot, row in enumerate(rows)})
            pool.batch.set_models([self._models[row] for row in rows])
        pool.qpos[:], pool.qvel[:], pool.warmstart[:] = state.qpos, state.qvel, state.qacc_warmstart
        return pool

    def _make_models(self, scenario: Scenario, owners: dict[bytes, int]) -> None:
        """Make the models of these rows of parameters, each of one robot, that are not there.

        Others are kept while there is room.
        """
        if len(self._models.keys() | owners) > MOST_MODELS:
            self._models = {row: model for row, model in self._models.items() if row in owners}
        missing = owners.keys() - self._models.keys()
        self._models |= {row: self._model_of(scenario, owners[row]) for row in missing}

    def _model_of(self, scenario: Scenario, robot: int) -> mujoco.MjModel:
        """The model of one of the robots; with delay, the PD law is not a part of it."""
        kd_scale, ground, dynamics = jax.tree.map(itemgetter(robot), _of_models(scenario))
        model = copy.copy(self.model) if self.max_delay else servo_model(self.model, kd_scale, dynamics)
        if dynamics is not None:
            set_dynamics(model, dynamics, self._scratch)
            # The limit of its motors is the law's.
            model.actuator_ctrllimited[:] = 0
        if model.nhfield:
            set_terrain(model, ground)
        return model


class _Pool:
    """A `Batch` of one size with live views of its arrays."""

    def __init__(self, batch: Batch) -> None:
        self.batch = batch
        self.parameters = np.zeros(0)
        self.qpos, self.qvel, self.ctrl = batch.bind("qpos"), batch.bind("qvel"), batch.bind("ctrl")
        self.warmstart = batch.bind("qacc_warmstart")
        self.push = batch.bind("xfrc_applied")[:, cassie.PELVIS_BODY, :3]

    def state(self, step: np.ndarray, history: np.ndarray) -> PhysicsState:
        return PhysicsState(self.qpos.copy(), self.qvel.copy(), self.warmstart.copy(), step, history)


class _Kinematics:
    """A `Batch` of one size for forward kinematics: its own, so that stepping copies no poses out."""

    def __init__(self, batch: Batch) -> None:
        self.batch = batch
        self.qpos, self.qvel = batch.bind("qpos"), batch.bind("qvel")
        self.bound = {name: batch.bind(name) for name in ("xpos", "xmat", "xipos", "ximat", "cvel", "subtree_com")}

    def __call__(self, state: PhysicsState) -> BodyState:
        self.qpos[:], self.qvel[:] = state.qpos, state.qvel
        self.batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL)
        matrices = (*state.qpos.shape[:1], -1, 3, 3)
        return BodyState(
            xpos=self.bound["xpos"].copy(),
            xmat=self.bound["xmat"].reshape(matrices).copy(),
            xipos=self.bound["xipos"].copy(),
            ximat=self.bound["ximat"].reshape(matrices).copy(),
            cvel=self.bound["cvel"].copy(),
            com=self.bound["subtree_com"][:, cassie.PELVIS_BODY].copy(),
        )


def _of_models(scenario: Scenario) -> tuple[Array, Ground, Dynamics | None]:
    """What of a scenario makes another compiled model."""
    ground = scenario.ground
    # The seed of ground that is not rough makes no difference.
    ground = replace(ground, seed=np.where(ground.rough == 0, 0, ground.seed))
    return scenario.kd_scale, ground, scenario.dynamics


def _force_segments(step: np.ndarray, scenario: Scenario, n_steps: int) -> Iterator[tuple[int, int]]:
    """Stretches of the next `n_steps` in which no robot's push starts or stops."""
    ends = np.stack([scenario.push_start, scenario.push_stop]) - step[:, None]
    edges = np.append(ends, [0, n_steps])
    return pairwise(np.unique(edges[(edges >= 0) & (edges <= n_steps)]).tolist())
