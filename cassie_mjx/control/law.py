"""The law from the robot's state to its PD targets: observe, act, and the mirror between the two steps.

Xie et al. 2018: every 32 ms a policy sees robot and reference and adds a residual to the reference angles of the ten
active joints; the sum is the PD target. Training, evaluation, blends, `NumpyPolicy` and `Controller` all call this.
"""

from dataclasses import dataclass
from typing import NamedTuple

from cassie_mjx.control.network import Network, action, start
from cassie_mjx.control.observation import OBSERVATIONS, Observation, Seen
from cassie_mjx.robot import cassie
from cassie_mjx.robot.arrays import Array, namespace


class LawCarry(NamedTuple):
    """What a law and a network at work carry from step to step."""

    sensing: Array
    """Of the observation, [B, H - 1, F]."""
    hidden: Array
    """Of the network, [B, N]. It is never mirrored: a symmetric policy's network is given every step as the first."""


@dataclass(frozen=True)
class ControlLaw:
    """What a policy observes, and what its actions mean."""

    observation: Observation = OBSERVATIONS["full"]
    symmetric: bool = False
    """Whether the policy learned the first of the stride's two steps alone, and takes the second as in a mirror."""

    def init(self, seen: Seen) -> Array:
        """The observation's carry of robots that have always seen this; see `Observation.init`."""
        return self.observation.init(seen)

    def begin(self, network: Network, seen: Seen) -> LawCarry:
        """The carry of robots that have always seen this, and of which the network remembers nothing."""
        return LawCarry(self.init(seen), start(network, len(seen.qpos)))

    def observe(self, carry: Array, seen: Seen) -> tuple[Array, Array]:
        """What the policy acts on, [B, O], in a mirror if it is symmetric and this is the second step; the next carry.

        Arguments as those of `Observation.update`.
        """
        observation, carry = self.observation.update(carry, seen)
        if self.symmetric:
            observation = canonicalize(self.observation, observation, second_step(seen.reference_qpos))
        return observation, carry

    def residual(self, reference_qpos: Array, action: Array) -> Array:
        """Residuals on the reference angles of the active joints, [B, 10], rad.

        Args:
          reference_qpos: of the reference motion one control step ahead, [B, 35].
          action: of the policy for what `observe` gave it, [B, 10], rad.
        """
        return decanonicalize(action, second_step(reference_qpos)) if self.symmetric else action

    def act(self, network: Network, carry: LawCarry, seen: Seen) -> tuple[Array, LawCarry]:
        """Residuals [B, 10], rad, of a deterministic policy, and the next carry."""
        observation, sensing = self.observe(carry.sensing, seen)
        acted, hidden = action(network, observation, carry.hidden)
        return self.residual(seen.reference_qpos, acted), LawCarry(sensing, hidden)


def target(reference_qpos: Array, residual: Array) -> Array:
    """PD targets [B, 10], rad: the active joints of the reference [B, 35] one control step ahead, and residuals."""
    # q* = q_ref + a
    return reference_qpos[:, cassie.ACTIVE_QPOS] + residual


def second_step(reference_qpos: Array) -> Array:
    """Whether a reference [B, 35] is in the second of its two steps, [B, 1], bool.

    The steps are mirror images. In the second one the left hip pitch is less than the right one.
    """
    left, right = cassie.HIP_PITCH_QPOS
    return (reference_qpos[:, left] < reference_qpos[:, right])[:, None]


def canonicalize(terms: Observation, observation: Array, second: Array) -> Array:
    """Observations [B, O] as in a mirror where it is the second step, [B, 1]: as if it were the first."""
    return namespace(observation, second).where(second, terms.mirrored(observation), observation)


def decanonicalize(action: Array, second: Array) -> Array:
    """Actions [B, 10] back from the mirror where it is the second step, [B, 1]."""
    return namespace(action, second).where(second, cassie.mirror_active(action), action)
