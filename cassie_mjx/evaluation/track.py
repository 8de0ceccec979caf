"""Where robots go, control step by control step, and how fast they are in their own heading frame.

Velocities are measured in the heading frame of the pelvis: that is what someone sees who drives the robot, and it needs
nothing that the agent remembers.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self, TypeVar

import jax
import numpy as np

from cassie_mjx.agents.types import Agent, AgentState
from cassie_mjx.envs.termination import has_fallen, height_over_ground
from cassie_mjx.evaluation.simulate import Simulation, run_to_end
from cassie_mjx.evaluation.trial import take
from cassie_mjx.physics.types import Physics, PhysicsState, Scenario, merge
from cassie_mjx.robot.arrays import Array, namespace
from cassie_mjx.robot.cassie import CONTROL_PERIOD_S, NQ, PELVIS_POSITION, PELVIS_QUATERNION
from cassie_mjx.robot.rotation import turned, yaw


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrackRecord:
    """Where robots have been so far. A robot that has fallen stays where it fell.

    Attributes:
      steps: control steps so far, [B].
      fell: whether the robot has fallen, [B], bool.
      places: x and y, m, and heading, rad, of the pelvis in the world: at the start and at the end of each of S control
        steps, [B, S + 1, 3]. Those to come are the last one so far.
    """

    steps: Array
    fell: Array
    places: Array

    @classmethod
    def begin(cls, qpos: Array, steps: int) -> Self:
        """Of robots at qpos [B, 35] that begin `steps` control steps."""
        robots = len(qpos)
        places = np.repeat(np.asarray(place_of(qpos))[:, None], steps + 1, axis=1)
        return cls(np.zeros(robots, np.int32), np.zeros(robots, bool), places)

    @classmethod
    def fallen(cls, robots: int, seconds: float) -> Self:
        """Of B = `robots` that are down at the origin from the start."""
        record = cls.begin(np.zeros((robots, NQ)), round(seconds / CONTROL_PERIOD_S))
        return replace(record, fell=np.ones(robots, bool))

    @property
    def finished(self) -> Array:
        """Whether the drive is over, [B]."""
        return self.fell | (self.steps >= self.places.shape[1] - 1)

    def sample(self, state: PhysicsState, target: Array, scenario: Scenario, share: float) -> Self:
        """See `simulate.Record.sample`: places are of whole control steps."""
        return self

    def update(self, state: PhysicsState, scenario: Scenario) -> Self:
        """See `simulate.Record.update`. A robot whose physics diverged has fallen; its track stays finite."""
        xp, steps = namespace(state.qpos), self.steps + 1
        diverged = ~xp.isfinite(state.qpos).all(axis=1)
        fell = has_fallen(height_over_ground(state.qpos, scenario.ground)) | diverged
        later = np.arange(self.places.shape[1]) >= steps[:, None]
        places = xp.where(later[..., None], place_of(state.qpos)[:, None], self.places)
        counted = replace(self, steps=steps, fell=fell)
        return merge(self.finished, self, merge(diverged, counted, replace(counted, places=places)))


Track = TypeVar("Track", bound=TrackRecord)


def place_of(qpos: Array) -> Array:
    """x, y and heading of the pelvis, [B, 3]."""
    heading = yaw(qpos[:, PELVIS_QUATERNION])
    return namespace(qpos).concatenate([qpos[:, PELVIS_POSITION[:2]], heading[:, None]], axis=1)


def drive(
    agent: Agent,
    physics: Physics,
    robots: AgentState,
    seconds: float,
    num_envs: int,
    progress: Callable[[int, int], None] | None = None,
    kind: type[Track] = TrackRecord,
) -> Track:
    """The tracks of robots that walk for a time, at most `num_envs` of them side by side, as NumPy arrays."""
    number, steps, parts = len(robots.physics.qpos), round(seconds / CONTROL_PERIOD_S), []
    for index in np.array_split(np.arange(number), -(-number // num_envs)):
        part = take(robots, index)
        scenario = Scenario.nominal(len(index), kd_scale=np.asarray(agent.kd_scale))
        simulation = Simulation(part, scenario, kind.begin(part.physics.qpos, steps))
        parts.append(run_to_end(agent, physics, simulation).record)
        if progress is not None:
            progress(int(index[-1]) + 1, number - int(index[-1]) - 1)
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def velocities(places: np.ndarray, period_s: float = CONTROL_PERIOD_S) -> np.ndarray:
    """Forward and lateral velocity, m/s, in the heading frame, and yaw rate, rad/s, from place to place, [B, S, 3].

    Args:
      places: x and y, m, and heading, rad, [B, S + 1, 3].
      period_s: time from one to the next, s.
    """
    heading = np.unwrap(places[..., 2], axis=1)
    middle = (heading[:, 1:] + heading[:, :-1]) / 2
    way = turned(np.diff(places[..., :2], axis=1), -middle)
    return np.concatenate([way, np.diff(heading, axis=1)[..., None]], axis=-1) / period_s


def over_strides(velocity: np.ndarray, steps: int) -> np.ndarray:
    """Means of velocities [B, S, 3] over the last `steps` control steps, [B, S, 3]; infinite before that."""
    sums = np.cumsum(np.insert(velocity, 0, 0.0, axis=1), axis=1)
    means = np.full_like(velocity, np.inf)
    means[:, steps - 1 :] = (sums[:, steps:] - sums[:, :-steps]) / steps
    return means
