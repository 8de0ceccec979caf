"""Where robots are along the reference motion, and their commands: pure functions of a `MotionState`."""

from typing import NamedTuple

from cassie_mjx.motion.command import Command
from cassie_mjx.motion.reference import RAMP_PER_S, ReferenceMotion, mean_speed, sample
from cassie_mjx.robot.arrays import Array, namespace
from cassie_mjx.robot.cassie import CONTROL_PERIOD_S, PELVIS_X


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
    """Where the path begins: world x of the point where the motion's x is 0, [B], m."""


def reference(motion: ReferenceMotion, state: MotionState, ahead: int = 0) -> tuple[Array, Array]:
    """The motion as commanded, in the world, `ahead` control steps from now: (qpos [B, 35], qvel [B, 32])."""
    qpos, qvel = sample(motion, state.time + ahead, state.command)
    x = qpos[:, PELVIS_X] + state.origin_x
    xp = namespace(qpos, state.origin_x)
    return xp.concatenate([x[:, None], qpos[:, PELVIS_X + 1 :]], axis=1), qvel


def tick(state: MotionState) -> MotionState:
    """One control step later."""
    return state._replace(time=state.time + 1, step=state.step + 1)


def follow(state: MotionState, lead: Array, leash_m: float) -> MotionState:
    """The same moment, with the path moved along x so that robots `lead` [B] ahead of it, m, are within the leash."""
    xp = namespace(state.origin_x, lead)
    return state._replace(origin_x=state.origin_x + lead - xp.clip(lead, -leash_m, leash_m))


def approach(motion: ReferenceMotion, state: MotionState) -> MotionState:
    """The same moment with a command nearer to its target, by 0.625 of the motion's speed a second; x does not jump."""
    xp = namespace(state.command.forward)
    step = RAMP_PER_S * CONTROL_PERIOD_S * mean_speed(motion)
    change = xp.clip(state.target_command.forward - state.command.forward, -step, step)
    command = Command(state.command.forward + change)
    before, after = (sample(motion, state.time, told)[0][:, PELVIS_X] for told in (state.command, command))
    return state._replace(command=command, origin_x=state.origin_x + before - after)
