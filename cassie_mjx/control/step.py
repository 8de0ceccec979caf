"""One control step of a policy at work, from what is sensed to PD targets, for NumPy and JAX arrays alike."""

from typing import NamedTuple

from cassie_mjx.control.command import onward
from cassie_mjx.control.law import ControlLaw, LawCarry, target
from cassie_mjx.control.network import Network
from cassie_mjx.control.observation import Seen
from cassie_mjx.control.path import Path, bend_beside, into, stay_beside
from cassie_mjx.motion.command import Command
from cassie_mjx.motion.reference import ReferenceMotion, sample
from cassie_mjx.robot.arrays import Array
from cassie_mjx.robot.cassie import PELVIS_X


class PolicyCarry(NamedTuple):
    """What a policy carries from step to step."""

    time: Array
    """Control step of the motion that it is at, [B], int32."""
    law: LawCarry
    """Of the observation and of the network."""
    path: Path
    """Where the path that it walks along lies in the world, leaves [B]; it begins as the world's x axis."""


def begin(
    law: ControlLaw, motion: ReferenceMotion, network: Network, time: Array, qpos: Array, qvel: Array
) -> PolicyCarry:
    """The carry of robots at qpos [B, 35] and qvel [B, 32] that begin at control steps `time` [B] of the motion."""
    seen = Seen(qpos, qvel, *sample(motion, time + 1))
    return PolicyCarry(time, law.begin(network, seen), Path.world(len(time)))


def policy_step(
    law: ControlLaw,
    motion: ReferenceMotion,
    network: Network,
    carry: PolicyCarry,
    qpos: Array,
    qvel: Array,
    command: Command | None,
) -> tuple[Array, PolicyCarry]:
    """PD targets [B, 10], rad, of a deterministic policy, and the next carry.

    Args:
      law: what it observes and what its actions mean.
      motion: what it imitates.
      network: the actor.
      carry: of `begin` or the last step.
      qpos: as sensed, [B, 35].
      qvel: as sensed, [B, 32].
      command: of now, leaves [B]; None for the motion's own speed along the world's x axis.
    """
    now, _ = sample(motion, carry.time, command)
    path, later = carry.path, carry.time + 1
    if command is not None:
        path, later = stay_beside(path, command, now, qpos, qvel), onward(motion, carry.time, command)
    qpos, qvel = into(path, qpos, qvel)
    ahead = sample(motion, later, command)
    residual, remembered = law.act(network, carry.law, Seen(qpos, qvel, *ahead, command))
    if command is not None:
        path = bend_beside(path, command, now, ahead[0], qpos[:, PELVIS_X])
    time = later % motion.qpos.shape[0] if motion.periodic else later
    return target(ahead[0], residual), PolicyCarry(time, remembered, path)
