"""Where robots are along the reference motion, and their commands: pure functions of a `MotionState`."""

from typing import NamedTuple

from cassie_mjx.control.path import Path, bend, shift
from cassie_mjx.motion.command import Command
from cassie_mjx.motion.reference import RAMP_PER_S, ReferenceMotion, mean_speed, sample
from cassie_mjx.robot.arrays import Array, namespace
from cassie_mjx.robot.cassie import CONTROL_PERIOD_S, PELVIS_X

LATERAL_PACE, YAW_PACE = 0.4, 1.6
"""Paces at which a walk is brought to another lateral velocity, m/s², and to another yaw rate, rad/s²."""
_STEERING_STEPS = CONTROL_PERIOD_S * LATERAL_PACE, CONTROL_PERIOD_S * YAW_PACE


class MotionState(NamedTuple):
    """Where each robot is along the reference motion and in its episode."""

    time: Array
    """Control steps since the motion began, [B], int32."""
    step: Array
    """Control steps since the episode began, [B], int32."""
    command: Command
    """The commands of now, leaves [B]."""
    target_command: Command
    """What the command moves to at a limited pace, leaves [B]; no robot senses it."""
    origin_x: Array
    """Where the motion begins: x, in the path's frame, of the point where the motion's x is 0, [B], m."""
    path: Path
    """Where the path that they walk along lies in the world, leaves [B]."""


def reference(motion: ReferenceMotion, state: MotionState, ahead: int = 0) -> tuple[Array, Array]:
    """The motion as commanded, `ahead` control steps from now, in the path's frame: (qpos [B, 35], qvel [B, 32])."""
    qpos, qvel = sample(motion, state.time + ahead, state.command)
    x = qpos[:, PELVIS_X] + state.origin_x
    xp = namespace(qpos, state.origin_x)
    return xp.concatenate([x[:, None], qpos[:, PELVIS_X + 1 :]], axis=1), qvel


def tick(motion: ReferenceMotion, state: MotionState) -> MotionState:
    """One control step later, along the path and on its bend."""
    now, ahead = (reference(motion, state, steps)[0] for steps in (0, 1))
    path = bend(state.path, state.command, now, ahead)
    return state._replace(time=state.time + 1, step=state.step + 1, path=path)


def follow(state: MotionState, lead: Array, aside: Array, leash_m: Array | float) -> MotionState:
    """The same moment, with the reference moved so that robots are within the leash.

    Args:
      state: of the robots.
      lead: how far ahead of the reference they are, [B], m.
      aside: how far to the left of it, [B], m; straight ahead the path stays, and robots come back to it.
      leash_m: the longest way from the reference along either axis, m, of all or of each, [B].
    """
    xp = namespace(state.origin_x, lead)
    path = shift(state.path, state.command, aside - xp.clip(aside, -leash_m, leash_m))
    return state._replace(origin_x=state.origin_x + lead - xp.clip(lead, -leash_m, leash_m), path=path)


def toward(motion: ReferenceMotion, command: Command, target: Command) -> Command:
    """The command one control step later on its way to a target: forward by 0.625 of the motion's speed a second."""
    xp = namespace(command.forward)
    paces = Command(RAMP_PER_S * CONTROL_PERIOD_S * mean_speed(motion), *_STEERING_STEPS)
    moved = (now + xp.clip(to - now, -step, step) for now, to, step in zip(command, target, paces, strict=True))
    return Command(*moved)


def approach(motion: ReferenceMotion, state: MotionState) -> MotionState:
    """The same moment with a command nearer to its target; the reference does not jump."""
    command = toward(motion, state.command, state.target_command)
    before, after = (sample(motion, state.time, told)[0][:, PELVIS_X] for told in (state.command, command))
    return state._replace(command=command, origin_x=state.origin_x + before - after)
