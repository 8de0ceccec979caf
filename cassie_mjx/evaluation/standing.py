"""How a policy stands: the drive of the suite `command` that comes from 2 m/s to rest."""

from dataclasses import dataclass, replace

import jax
import mujoco
import numpy as np

from cassie_mjx.evaluation.record import motor_effort
from cassie_mjx.evaluation.setup import LONG_WALK_S, SuiteResult
from cassie_mjx.evaluation.track import TrackRecord
from cassie_mjx.evaluation.trial import Metric
from cassie_mjx.physics.types import PhysicsState, Scenario, merge
from cassie_mjx.robot import cassie
from cassie_mjx.robot.arrays import Array, namespace
from cassie_mjx.robot.cassie import CONTROL_PERIOD_S

STOP_S, SETTLE_S = 3.0, 3.0
"""Time from the command to stand, at 2 m/s, to standing, and from there to where its soles are to stay, s."""
STAND_S = STOP_S + LONG_WALK_S
"""Duration of the drive, s."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PoseRecord(TrackRecord):
    """A track with all that is needed to see how a robot stands.

    Attributes:
      qpos: at the start and at the end of each of S control steps, [B, S + 1, 35]; those to come are the last so far.
      torque: mean over motors and each control step of |torque|, [B, S], N·m.
      pending: the present control step's part of that mean, [B].
    """

    qpos: Array
    torque: Array
    pending: Array

    @classmethod
    def begin(cls, qpos: Array, steps: int) -> "PoseRecord":
        """Of robots at qpos [B, 35] that begin `steps` control steps."""
        track = TrackRecord.begin(qpos, steps)
        poses = np.repeat(np.asarray(qpos)[:, None], steps + 1, axis=1)
        torque = np.zeros((len(qpos), steps))
        return cls(**vars(track), qpos=poses, torque=torque, pending=np.zeros(len(qpos)))

    def sample(self, state: PhysicsState, target: Array, scenario: Scenario, share: float) -> "PoseRecord":
        """See `simulate.Record.sample`."""
        return replace(self, pending=self.pending + share * motor_effort(state, target, scenario)[:, 0])

    def update(self, state: PhysicsState, scenario: Scenario) -> "PoseRecord":
        """See `simulate.Record.update`."""
        xp, track = namespace(state.qpos), super().update(state, scenario)
        number = np.arange(self.places.shape[1])
        poses = xp.where((number >= track.steps[:, None])[..., None], state.qpos[:, None], self.qpos)
        torque = xp.where(number[1:] == track.steps[:, None], self.pending[:, None], self.torque)
        rested = replace(track, pending=xp.zeros_like(self.pending))
        finite = xp.isfinite(state.qpos).all(axis=1) & xp.isfinite(self.pending)
        return merge(self.finished | ~finite, rested, replace(rested, qpos=poses, torque=torque))


def standing_result(model: mujoco.MjModel, stood: PoseRecord, stepped: PoseRecord) -> SuiteResult:
    """The share that stands for 60 s; of those, how far a sole goes and what standing asks of the motors.

    Args:
      model: of the robot.
      stood: robots told to stand, `STAND_S` long.
      stepped: robots that step on the spot; their torque over the last half is what standing is compared with.
    """
    up, settled = ~stood.fell, round((STOP_S + SETTLE_S) / CONTROL_PERIOD_S)
    metrics = [Metric("stand_survived_60s", float(up.mean()), "1", len(up))]
    if up.any():
        soles = soles_of(model, stood.qpos[up, settled:])
        way = np.linalg.norm((soles - soles[:, :1])[..., :2], axis=-1).max()
        metrics.append(Metric("stand_foot_slip_m", float(way), "m", int(up.sum())))
    if up.any() and not stepped.fell.all():
        stepping = stepped.torque[~stepped.fell, stepped.torque.shape[1] // 2 :].mean()
        share = stood.torque[up, settled:].mean() / stepping
        metrics.append(Metric("stand_torque_share", float(share), "1", int(up.sum())))
    return SuiteResult(metrics)


def soles_of(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Middles of the feet's capsules, of robots at qpos [..., 35], left and right, [..., 2, 3], m."""
    data, soles = mujoco.MjData(model), []
    for each in qpos.reshape(-1, cassie.NQ):
        data.qpos[:] = each
        mujoco.mj_kinematics(model, data)
        feet = data.xmat[cassie.FOOT_BODIES].reshape(2, 3, 3)
        soles.append(data.xpos[cassie.FOOT_BODIES] + feet @ cassie.SOLE_AXIS)
    return np.array(soles).reshape(*qpos.shape[:-1], 2, 3)
