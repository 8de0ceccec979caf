"""What can be evaluated: heuristic walkers and trained policies, each as a `Subject` of the sweeps."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cassie_mjx import controller, robot
from cassie_mjx.controller import CONTROLLERS, ControllerState
from cassie_mjx.envs import observation
from cassie_mjx.export import NumpyPolicy, find, learner_policy, shipped_policies
from cassie_mjx.model import CONTROL_PERIOD_S, standing
from cassie_mjx.physics.types import Array, Disturbance, Physics, PhysicsState
from cassie_mjx.ppo import networks
from cassie_mjx.reference import ReferenceMotion, sample
from cassie_mjx.returns import EPISODE_STEPS, STARTS, referee, walk_returns
from cassie_mjx.trials import Measured, Subject, Walker, carried, fallen

CONTROLLER_PREFIX = "controller:"
WARM_UP_STRIDES = 9


def resolve(name: str) -> Subject:
    """The subject of that name: a policy that we ship or its .npz file, a training run's directory, "controller:NAME".

    Raises:
      ValueError: there is none.
    """
    preset = name.removeprefix(CONTROLLER_PREFIX)
    if name.startswith(CONTROLLER_PREFIX) and preset in CONTROLLERS:
        return ControllerSubject(preset)
    path = find(name)
    if path is None:
        known = ", ".join([*shipped_policies(), *(CONTROLLER_PREFIX + preset for preset in CONTROLLERS)])
        raise ValueError(f"policy={name} is none of {known}, nor a policy's .npz file, nor a run's directory.")
    return PolicySubject(name, NumpyPolicy.load(path))


def copied_along(subject: Subject, physics: Physics, walker: Walker, calls: np.ndarray) -> Walker:
    """One robot walks on, and a copy of it is taken before each of the acts `calls` [B], counted from 0, back at x = 0.

    Raises:
      ValueError: it falls before it walks steadily.
    """
    act_steps = round(subject.period_s / physics.model.opt.timestep)
    taken = {}
    for call in range(calls.max() + 1):
        if call in calls:
            taken[call] = walker
        target, memory = subject.act(physics, walker.physics, walker.memory)
        moved = physics.advance(walker.physics, np.asarray(target, float), Disturbance.none(1), act_steps)
        walker = Walker(moved, memory)
    walkers = jax.tree.map(lambda *leaves: np.concatenate(leaves), *(taken[call] for call in calls.tolist()))
    if fallen(walkers.physics.qpos, np.zeros(len(calls))).any():
        raise ValueError(f"{subject.name} falls before it walks steadily, so there is nothing to measure.")
    return carried(subject, walkers, -walkers.physics.qpos[:, :3] * np.array([1.0, 0.0, 0.0]))


class ControllerSubject:
    """A heuristic walker as a `Subject`; phase 0 of its stride is where the left leg takes over."""

    def __init__(self, name: str) -> None:
        """Take the controller `name` of `CONTROLLERS`."""
        self.name = CONTROLLER_PREFIX + name
        self.provenance: Mapping[str, Any] = {}
        self.config = CONTROLLERS[name]
        self.period_s = self.config.period
        self._step = jax.jit(controller.step)

    def start(self, physics: Physics, phases: np.ndarray) -> Walker:
        """See `Subject.start`: one robot walks nine strides from standing, and is copied along the tenth."""
        state = physics.init(standing(physics.model)[None], np.zeros((1, robot.NV)))
        walker = Walker(state, controller.init(self.config, state.qpos, state.qvel, physics.bodies(state)))
        step_calls = round(self.config.step_time / self.period_s)
        # The walk begins half a step before the left leg takes over.
        first = step_calls // 2 + 2 * step_calls * WARM_UP_STRIDES
        calls = first + np.round(2 * step_calls * phases).astype(int)
        return copied_along(self, physics, walker, calls)

    def returns(self, physics: Physics, delay: int = 0) -> list[Measured]:
        """See `Subject.returns`: a controller imitates nothing, so it has none."""
        return []

    def act(self, physics: Physics, seen: PhysicsState, memory: ControllerState) -> tuple[Array, ControllerState]:
        """See `Subject.act`."""
        return self._step(self.config, memory, seen.qpos, seen.qvel, physics.bodies(seen), self.period_s)

    def carried(self, memory: ControllerState, offset: np.ndarray) -> ControllerState:
        """See `Subject.carried`."""
        along = offset * np.array([1.0, 1.0, 0.0])
        return replace(memory, liftoff_w=memory.liftoff_w + offset, line_w=memory.line_w + along)


class PolicySubject:
    """A trained policy, deterministic, as a `Subject`; its memory is the sample of the reference it is at, [B]."""

    period_s = CONTROL_PERIOD_S

    def __init__(self, name: str, saved: NumpyPolicy) -> None:
        """Take a saved policy; raises ValueError if it was made for another layout of the observation."""
        self.name, self.provenance = name, saved.provenance
        policy = learner_policy(saved)
        self.motion = ReferenceMotion(
            jnp.asarray(saved.reference_qpos, jnp.float32),
            jnp.asarray(saved.reference_qvel, jnp.float32),
            jnp.asarray(saved.reference_stride_length, jnp.float32),
        )
        self._mode = jax.jit(lambda seen: networks.mode(policy, seen))
        self._target = jax.jit(self._pd_target)

    def start(self, physics: Physics, phases: np.ndarray) -> Walker:
        """See `Subject.start`: one robot walks nine strides from the reference, and is copied along the tenth."""
        samples = len(self.motion.qpos)
        qpos, qvel = sample(self.motion, np.zeros(1, int), np.zeros(1, int))
        walker = Walker(physics.init(np.asarray(qpos, float), np.asarray(qvel, float)), np.zeros(1, np.int32))
        steps = samples * WARM_UP_STRIDES + np.round(samples * phases).astype(int)
        return copied_along(self, physics, walker, steps)

    def returns(self, physics: Physics, delay: int = 0) -> list[Measured]:
        """See `Subject.returns`."""
        disturbance = replace(Disturbance.none(STARTS), delay=np.full(STARTS, delay, np.int32))
        figures = walk_returns(self._mode, referee(self.motion, physics), disturbance)
        unit = f"of {EPISODE_STEPS}"
        return [Measured(name, figures[name], unit, STARTS) for name in ("return_plain", "return_weighted")]

    def act(self, physics: Physics, seen: PhysicsState, memory: np.ndarray) -> tuple[Array, np.ndarray]:
        """See `Subject.act`."""
        return self._target(seen.qpos, seen.qvel, memory), (memory + 1) % len(self.motion.qpos)

    def carried(self, memory: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """See `Subject.carried`: a policy remembers no place."""
        return memory

    def _pd_target(self, qpos: Array, qvel: Array, phase: Array) -> jax.Array:
        ahead, ahead_velocity = sample(self.motion, phase + 1, jnp.zeros_like(phase))
        action = self._mode(observation.build(qpos, qvel, ahead, ahead_velocity))
        return ahead[:, robot.ACTIVE_QPOS] + action
