"""A trained policy as an agent."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cassie_mjx.agents.numpy_policy import NumpyPolicy
from cassie_mjx.agents.policy_file import learner_policy
from cassie_mjx.agents.saved_law import control_law
from cassie_mjx.agents.types import Sensed
from cassie_mjx.control.law import ControlLaw
from cassie_mjx.control.network import Network
from cassie_mjx.control.step import PolicyCarry, begin, policy_step
from cassie_mjx.motion.command import Command, speed_factor
from cassie_mjx.motion.reference import ReferenceMotion, sample, stretch
from cassie_mjx.ppo import networks
from cassie_mjx.robot import cassie
from cassie_mjx.robot.arrays import Array
from cassie_mjx.robot.cassie import CONTROL_PERIOD_S


class PolicyAgent:
    """A trained policy, deterministic, as an `Agent`."""

    period_s, needs_bodies = CONTROL_PERIOD_S, False

    def __init__(
        self,
        name: str,
        law: ControlLaw,
        motion: ReferenceMotion,
        network: Network,
        kd_scale: float = 1.0,
        provenance: Mapping[str, Any] | None = None,
        step: Callable[..., Any] | None = None,
    ) -> None:
        """Compile the policy.

        Args:
          name: of the agent.
          law: what it observes and what its actions mean.
          motion: what it imitates.
          network: the actor.
          kd_scale: factor on the D gains.
          provenance: where it came from.
          step: `policy_step` with law and motion bound, compiled already with the network as an argument: for many
            networks one after another. Unless given, it is compiled for this network.
        """
        self.name, self.law, self.motion, self.network = name, law, motion, network
        self.kd_scale, self.provenance = kd_scale, provenance or {}
        bound = partial(policy_step, law, motion, network)
        self._step = jax.jit(bound) if step is None else partial(step, network)
        self._begin = jax.jit(partial(begin, law, motion, network))

    @property
    def lead(self) -> "PolicyAgent":
        """See `Agent.lead`."""
        return self

    @property
    def stride_acts(self) -> int:
        """See `Agent.stride_acts`."""
        return self.motion.qpos.shape[0]

    def acts_before(self, stride: int) -> int:
        """See `Agent.acts_before`."""
        return stride * self.stride_acts

    def initial_state(self, robots: int) -> tuple[np.ndarray, np.ndarray]:
        """See `Agent.initial_state`: the first sample of the motion."""
        qpos, qvel = sample(self.motion, np.zeros(robots, int))
        return np.asarray(qpos, float), np.asarray(qvel, float)

    def init(self, sensed: Sensed, time: Array | None = None) -> PolicyCarry:
        """See `Agent.init`; `time` [B] is the control step of the motion that robots are at, 0 unless given."""
        time = np.zeros(len(sensed.qpos), np.int32) if time is None else time
        return jax.tree.map(np.asarray, self._begin(time, sensed.qpos, sensed.qvel))

    def step(self, carry: PolicyCarry, sensed: Sensed, command: Command | None) -> tuple[Array, PolicyCarry]:
        """See `Agent.step`."""
        return self._step(carry, sensed.qpos, sensed.qvel, command)

    def moved(self, carry: PolicyCarry, offset: np.ndarray) -> PolicyCarry:
        """See `Agent.moved`: the path goes along."""
        x, y = carry.path.x + offset[:, 0], carry.path.y + offset[:, 1]
        return carry._replace(path=carry.path._replace(x=x, y=y))

    def take_over(self, carry: PolicyCarry) -> PolicyCarry:
        """See `Agent.take_over`."""
        return carry


def saved_agent(name: str, saved: NumpyPolicy, speed: str | None = None) -> PolicyAgent:
    """The agent of a saved policy, and of a commanded speed, if not its own.

    Raises:
      ValueError: it was made for another layout of the observation or for gains that no engine of ours has, or its
        reference cannot have that speed.
    """
    kd_scale = float(saved.d_gain[0] / cassie.D_GAIN[0])
    if not (np.allclose(saved.d_gain, kd_scale * cassie.D_GAIN) and np.allclose(saved.p_gain, cassie.P_GAIN)):
        raise ValueError(f"policy={name} has PD gains other than the published ones with all D scaled alike.")
    network = networks.acting(learner_policy(saved))
    arrays = (saved.reference_qpos, saved.reference_qvel, saved.reference_stride_length)
    qpos, qvel, stride_length = (jnp.asarray(array, jnp.float32) for array in arrays)
    motion = ReferenceMotion(qpos, qvel, stride_length)
    if speed is not None and speed_factor(speed) != saved.speed:
        if saved.speed == 0:
            raise ValueError(f"policy={name} with speed={speed}: a reference at 0x has no speed to be stretched.")
        motion = stretch(motion, speed_factor(speed) / saved.speed)
    told = name if speed is None else f"{name} speed={speed}"
    return PolicyAgent(told, control_law(saved), motion, network, kd_scale, saved.provenance)
