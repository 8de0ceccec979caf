"""A trial of an agent: what a robot is put through, from which start, and how it did."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import numpy as np

from cassie_mjx.agents.types import Agent, AgentState
from cassie_mjx.envs.scenario import PUSH_S
from cassie_mjx.physics.types import PhysicsState, Scenario
from cassie_mjx.robot.cassie import CONTROL_PERIOD_S, PELVIS_POSITION, PELVIS_QUATERNION
from cassie_mjx.robot.dynamics import Dynamics
from cassie_mjx.robot.ground import FLAT, START_X_M, Ground, Terrain
from cassie_mjx.robot.rotation import yaw

AFTER_PUSH_S = 4.0


class Metric(NamedTuple):
    """One figure of an agent."""

    quantity: str
    value: float
    unit: str
    n: int
    """Trials behind the figure or, for a limit, phases of the stride."""


class Push(NamedTuple):
    """A force at the pelvis for a while."""

    forward: float
    """N, in the heading frame at the start of the trial."""
    left: float
    """N."""
    start_s: float = 0.0
    """When it begins, s since the start of the trial."""
    seconds: float = PUSH_S
    """How long it lasts, s."""


@dataclass(frozen=True)
class Trial:
    """One robot's task: to stay up."""

    start: int
    """Index of the robot it starts as, among the starting robots."""
    seconds: float
    """Duration, s; rounded up to whole control steps of 32 ms."""
    pushes: tuple[Push, ...] = ()
    """Forces at the pelvis; those at the same time add up."""
    terrain: Terrain = FLAT
    """What it walks on; the robot starts on a crest of hills, and a metre before anything else begins."""
    delay: int = 0
    """Age of the state that agent and PD loop sense, physics steps."""
    slope: tuple[float, float] = (0.0, 0.0)
    """How much steeper the ground is along x and along y, rad."""
    dynamics: Dynamics | None = None
    """How the robot differs from the model, its fields without the axis B; None for not at all."""

    @property
    def control_steps(self) -> int:
        """Control steps of 32 ms in the trial."""
        return math.ceil(self.seconds / CONTROL_PERIOD_S - 1e-9)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class EpisodeResult:
    """How trials went, each field [B]. A fallen robot stays where it fell.

    Attributes:
      survived_s: time until the fall, or the trial's duration, s.
      fell: whether the robot fell before the end.
      lowest_m: smallest height of the pelvis over the ground below it, m.
      height_m: mean height of the pelvis over the ground below it, m.
      speed_mps: mean velocity of the pelvis along x in the last 5 s of the trial, m/s.
      distance_m: way of the pelvis along x, m.
      drift_m: way of the pelvis along y, m, left positive.
      torque_nm: mean over time and the ten motors of the torque's size at the joint, N·m.
      power_w: mean over time of the motors' positive work rates' sum, W: sum over motors of max(torque x velocity, 0).
    """

    survived_s: np.ndarray
    fell: np.ndarray
    lowest_m: np.ndarray
    height_m: np.ndarray
    speed_mps: np.ndarray
    distance_m: np.ndarray
    drift_m: np.ndarray
    torque_nm: np.ndarray
    power_w: np.ndarray


class NeverSteady(ValueError):
    """An agent falls before it walks steadily, which is where trials start."""


def ground_of(trials: Sequence[Trial]) -> Ground:
    """What the trials are walked on, [B]."""
    ground = Ground.of([trial.terrain for trial in trials])
    return replace(ground, slope=ground.slope + np.array([trial.slope for trial in trials]))


def scenario_of(
    agent: Agent, trials: Sequence[Trial], state: PhysicsState, hertz: float, pushes: int = 1, varied: bool = False
) -> Scenario:
    """What the trials do to robots that start them in `state`, [B].

    Args:
      agent: what walks.
      trials: of the robots.
      state: theirs, as the trials start.
      hertz: physics steps a second.
      pushes: the most that a trial has.
      varied: whether there is room for robots that differ from the model, if none of these does.

    Raises:
      ValueError: a trial has more pushes.
    """
    most = max((len(trial.pushes) for trial in trials), default=0)
    if most > pushes:
        raise ValueError(f"A trial has {most} pushes where there is room for {pushes}.")
    robots = [trial.dynamics for trial in trials]
    still = Push(0.0, 0.0, seconds=0.0)
    table = np.array([trial.pushes + (still,) * (pushes - len(trial.pushes)) for trial in trials], float)
    forward, left, start_s, seconds = np.moveaxis(table, 2, 0)
    heading = yaw(state.qpos[:, PELVIS_QUATERNION])[:, None]
    cos, sin = np.cos(heading), np.sin(heading)
    start = np.asarray(state.step)[:, None] + np.rint(start_s * hertz).astype(np.int32)
    return Scenario.nominal(
        len(trials),
        pushes,
        # F_w = R_z(yaw) F
        push=np.stack([forward * cos - left * sin, forward * sin + left * cos, np.zeros_like(left)], axis=2),
        push_start=start,
        push_stop=start + np.rint(seconds * hertz).astype(np.int32),
        delay=np.array([trial.delay for trial in trials], np.int32),
        ground=ground_of(trials),
        dynamics=Dynamics.of(robots) if varied or any(robots) else None,
        kd_scale=np.asarray(agent.kd_scale),
    )


def placed(agent: Agent, starts: AgentState, trials: Sequence[Trial]) -> AgentState:
    """The robots as which the trials start, [B]; those on terrain are carried to where it starts."""
    ground = ground_of(trials)
    offset = np.stack([START_X_M * ground.uneven, np.zeros(len(trials)), ground.sine], axis=1)
    return moved(agent, take(starts, np.array([trial.start for trial in trials])), offset)


def moved(agent: Agent, robots: AgentState, offset: np.ndarray) -> AgentState:
    """Robots carried by `offset` [B, 3], m, in the world, with all that agent and engine remember of the place."""
    state, carry = robots
    qpos, history = np.array(state.qpos), np.array(state.history)
    qpos[:, PELVIS_POSITION] += offset
    history[:, :, PELVIS_POSITION] += offset[:, None]
    return AgentState(replace(state, qpos=qpos, history=history), agent.moved(carry, offset))


def take(tree: Any, index: np.ndarray) -> Any:
    """Robots `index` of a pytree with the axis B first, as NumPy arrays."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[index], tree)
