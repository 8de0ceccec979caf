"""Where robots are along the reference motion, and their commands: pure functions of a `MotionState`."""

from typing import NamedTuple

from cassie_mjx.control.path import Path, bend, shift
from cassie_mjx.motion.command import Command
from cassie_mjx.motion.reference import RAMP_PER_S, ReferenceMotion, mean_speed, sample
from cassie_mjx.robot import cassie
from cassie_mjx.robot.arrays import Array, namespace
from cassie_mjx.robot.cassie import CONTROL_PERIOD_S, PELVIS_X

BRAKING, LATERAL_PACE, YAW_PACE = 1.5, 0.4, 1.6
"""Paces at which a walk is slowed down, m/s², brought to another lateral velocity, m/s², and to another yaw rate,
rad/s²."""
STAND_S = 5 * CONTROL_PERIOD_S
"""Duration of the change from steps to standing and back, s: about half a step."""
LEAST_STRIDE = 2 * round(STAND_S / CONTROL_PERIOD_S)
"""Control steps of the shortest stride in whose steps a robot can come to stand."""
STEP_OUT_MPS = 0.3
"""Horizontal speed of the pelvis, m/s, at which a robot that stands begins to step: its capture point, 0.32 s ahead, is
then 0.1 m away, at the end of its feet."""
SWAY_MPS = 0.5
"""Horizontal speed of the pelvis, m/s, below which a robot comes to stand; steps on the spot sway by up to 0.4 m/s."""


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
    qpos, qvel = sample(motion, onward(motion, state.time, state.command, ahead), state.command)
    x = qpos[:, PELVIS_X] + state.origin_x
    xp = namespace(qpos, state.origin_x)
    return xp.concatenate([x[:, None], qpos[:, PELVIS_X + 1 :]], axis=1), qvel


def tick(motion: ReferenceMotion, state: MotionState) -> MotionState:
    """One control step later, along the path and on its bend."""
    now, ahead = (reference(motion, state, steps)[0] for steps in (0, 1))
    path = bend(state.path, state.command, now, ahead)
    return state._replace(time=onward(motion, state.time, state.command), step=state.step + 1, path=path)


def onward(motion: ReferenceMotion, time: Array, command: Command, steps: int = 1) -> Array:
    """The motion's time [B], 0 or 1 `steps` later: it rests with robots that stand, once a foot has landed."""
    walks = namespace(time, command.forward).asarray(command.stand) < 1
    return time + steps * (walks | (since_landing(motion, time) > 0))


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


def toward(motion: ReferenceMotion, command: Command, target: Command, time: Array, qvel: Array) -> Command:
    """The command one control step later on its way to a target.

    Forward it gains 0.625 of the motion's speed a second, and brakes faster. Whether a robot stands or steps is decided
    as a foot lands, and while the clock rests. It stands if it is told to, is on the spot, and is slower than
    `STEP_OUT_MPS` if it stands already, `SWAY_MPS` if it steps. It walks only when it no longer stands.

    Args:
      motion: what is walked.
      command: of now.
      target: what it is to become; its `stand` is 0 or 1.
      time: control steps since the motion began, [B].
      qvel: as sensed, [B, 32].
    """
    xp, ramp = namespace(command.forward, qvel), CONTROL_PERIOD_S / STAND_S
    calm_mps = xp.where(command.stand == 1, STEP_OUT_MPS, SWAY_MPS)
    calm = xp.square(qvel[:, cassie.HORIZONTAL_VELOCITY]).sum(axis=-1) < calm_mps**2
    steps_since = since_landing(motion, time)
    # Between landings the change goes on. On the way to standing, `stand` is below 0.5 in the first half of its time.
    comes_to_stand = (command.stand > 0) & ((command.stand > 0.5) == (steps_since * ramp > 0.5))
    decides = target.stand * (command.on_the_spot & calm)
    wanted = xp.where(steps_since == 0, decides, comes_to_stand)
    stand = command.stand + xp.clip(wanted - command.stand, -ramp, ramp)
    speeding = RAMP_PER_S * mean_speed(motion)
    paces = xp.where(abs(target.forward) < abs(command.forward), BRAKING, speeding), LATERAL_PACE, YAW_PACE
    steps = (CONTROL_PERIOD_S * pace * (stand == 0) for pace in paces)
    moved = [now + xp.clip(to - now, -step, step) for now, to, step in zip(command, target, steps, strict=False)]
    return Command(*moved, stand=stand)


def since_landing(motion: ReferenceMotion, time: Array) -> Array:
    """Control steps since a foot landed, [B]: strides begin so, and the second step in their middle."""
    return time % (motion.qpos.shape[0] // 2)


def approach(motion: ReferenceMotion, state: MotionState, qvel: Array) -> MotionState:
    """The same moment with a command nearer to its target; the reference does not jump.

    Args:
      motion: what is walked.
      state: of the robots.
      qvel: as sensed, [B, 32].
    """
    command = toward(motion, state.command, state.target_command, state.time, qvel)
    before, after = (sample(motion, state.time, told)[0][:, PELVIS_X] for told in (state.command, command))
    return state._replace(command=command, origin_x=state.origin_x + before - after)
