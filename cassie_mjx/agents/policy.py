"""What can be evaluated: heuristic walkers, trained policies and blends of them, each as a `Subject` of the sweeps."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from cassie_mjx.agents.numpy_policy import NumpyPolicy
from cassie_mjx.agents.policy_file import learner_policy
from cassie_mjx.control import observation
from cassie_mjx.control.command import speed_factor
from cassie_mjx.evaluation.returns import EPISODE_STEPS, STARTS, referee, walk_returns
from cassie_mjx.evaluation.steady import WARM_UP_STRIDES, copied_along
from cassie_mjx.evaluation.trial import Measured, Walker
from cassie_mjx.motion.reference import ReferenceMotion, nearest_sample, sample, stretch
from cassie_mjx.physics.types import Array, Disturbance, Physics, PhysicsState
from cassie_mjx.ppo import networks
from cassie_mjx.robot import cassie
from cassie_mjx.robot.model import CONTROL_PERIOD_S


class PolicyAgent:
    """A trained policy, deterministic, as a `Subject`; its memory is the sample of the reference it is at, [B]."""

    period_s = CONTROL_PERIOD_S

    def __init__(self, name: str, saved: NumpyPolicy, speed: str | None = None) -> None:
        """Take a saved policy, and a speed at which it is told to walk, if not its own.

        Raises:
          ValueError: it was made for another layout of the observation or for gains that no engine of ours has, or its
            reference cannot have that speed.
        """
        self.damping = float(saved.d_gain[0] / cassie.D_GAIN[0])
        if not (np.allclose(saved.d_gain, self.damping * cassie.D_GAIN) and np.allclose(saved.p_gain, cassie.P_GAIN)):
            raise ValueError(f"policy={name} has PD gains other than the published ones with all D scaled alike.")
        self.name, self.provenance = name if speed is None else f"{name} speed={speed}", saved.provenance
        policy = learner_policy(saved)
        self.motion = ReferenceMotion(
            jnp.asarray(saved.reference_qpos, jnp.float32),
            jnp.asarray(saved.reference_qvel, jnp.float32),
            jnp.asarray(saved.reference_stride_length, jnp.float32),
        )
        if speed is not None and speed_factor(speed) != saved.speed:
            if saved.speed == 0:
                raise ValueError(f"policy={name} with speed={speed}: a reference at 0x has no speed to be stretched.")
            self.motion = stretch(self.motion, speed_factor(speed) / saved.speed)
        mode = partial(networks.mode, policy)
        self.mode = jax.jit(observation.symmetric(mode) if saved.mirror else mode)
        self._target = jax.jit(self._pd_target)

    def start(self, physics: Physics, phases: np.ndarray) -> Walker:
        """See `Subject.start`: one robot walks nine strides from the reference, and is copied along the tenth."""
        samples = len(self.motion.qpos)
        qpos, qvel = sample(self.motion, np.zeros(1, int), np.zeros(1, int))
        walker = Walker(physics.init(np.asarray(qpos, float), np.asarray(qvel, float)), np.zeros(1, np.int32))
        steps = samples * WARM_UP_STRIDES + nearest_sample(phases, samples)
        return copied_along(self, physics, walker, steps)

    def returns(self, physics: Physics, delay: int = 0) -> list[Measured]:
        """See `Subject.returns`."""
        disturbance = replace(Disturbance.none(STARTS), delay=np.full(STARTS, delay, np.int32))
        figures = walk_returns(self.mode, referee(self.motion, physics), disturbance)
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
        action = self.mode(observation.build(qpos, qvel, ahead, ahead_velocity))
        return ahead[:, cassie.ACTIVE_QPOS] + action
