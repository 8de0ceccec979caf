"""A trial of a walker: what walks, what it is put through, when it has fallen, and how it did."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol, TypeAlias

import jax
import numpy as np

from cassie_mjx.envs.scenario import CREST_X_M
from cassie_mjx.physics.types import Array, Disturbance, Physics, PhysicsState, delayed, namespace
from cassie_mjx.robot import cassie
from cassie_mjx.robot.model import CONTROL_PERIOD_S

SPEED_WINDOW_S = 5.0
AFTER_PUSH_S = 4.0

Memory: TypeAlias = Any
"""What a subject carries from act to act: a pytree whose leaves have the robots' axis B first."""


class Measured(NamedTuple):
    """One figure of a subject."""

    quantity: str
    value: float
    unit: str
    n: int
    """Trials behind the figure or, for a limit, phases of the stride."""


class Walker(NamedTuple):
    """B robots in the middle of a walk."""

    physics: PhysicsState
    memory: Memory


class Subject(Protocol):
    """Whatever walks: a policy, a controller."""

    name: str
    period_s: float
    """Time between two acts, s: 0.032 or a whole fraction of it."""
    damping: float
    """Factor on the D gains of the PD law that holds its targets."""

    @property
    def provenance(self) -> Mapping[str, Any]:
        """Where it came from; empty for what this package's code alone defines."""
        ...

    def start(self, physics: Physics, phases: np.ndarray) -> Walker:
        """Robots in steady walking along +x, with the pelvis at x = 0, at `phases` [B] of the stride, 0 to 1."""
        ...

    def returns(self, physics: Physics, delay: int = 0) -> list[Measured]:
        """Returns of walking on the flat, sensing what was `delay` physics steps ago; none if it imitates nothing."""
        ...

    def act(self, physics: Physics, seen: PhysicsState, memory: Memory) -> tuple[Array, Memory]:
        """PD targets [B, 10], rad, for the state as sensed (old, if there is a delay), and the next memory."""
        ...

    def carried(self, memory: Memory, offset: np.ndarray) -> Memory:
        """The memory of robots that were carried by `offset` [B, 3], m, in the world."""
        ...


@dataclass(frozen=True)
class Trial:
    """One robot's task: to stay up."""

    start: int
    """Index of the robot it starts as, among the starting walkers."""
    seconds: float
    """Duration, s; rounded up to whole control steps of 32 ms."""
    push: tuple[float, float] = (0.0, 0.0)
    """Force at the pelvis in the first 0.2 s, N, forward and left in the heading frame at the start."""
    terrain: float = 0.0
    """Height h of the terrain z = h sin x, m; above 0 the robot starts on a crest."""
    delay: int = 0
    """Age of the state that subject and PD loop see, physics steps."""

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
    """A walker falls before it walks steadily, which is where trials start."""


def fallen(qpos: Array, terrain: Array) -> Array:
    """Whether the pelvis of qpos [..., 35] is less than 0.6 m or more than 1.2 m over the ground below it, or NaN."""
    height = height_over_ground(qpos, terrain)
    return ~((height >= cassie.FALL_LOW_M) & (height <= cassie.FALL_HIGH_M))


def height_over_ground(qpos: Array, terrain: Array) -> Array:
    """Height of the pelvis of qpos [..., 35] over the terrain z = h sin x below it, m; `terrain` is h, [...], m."""
    return qpos[..., 2] - terrain * namespace(qpos).sin(qpos[..., 0])


def heading(qpos: Array) -> Array:
    """Yaw of the pelvis of qpos [B, 35], [B], rad."""
    w, x, y, z = qpos[:, 3:7].T
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))


def disturbances(trials: Sequence[Trial], state: PhysicsState, push_steps: int) -> Disturbance:
    """What the trials do to robots that start them in `state`, [B]; a push acts from now on for `push_steps` steps."""
    yaw = heading(state.qpos)
    forward, left = np.array([trial.push for trial in trials], float).reshape(-1, 2).T
    # F_w = R_z(yaw) F
    push = np.stack(
        [forward * np.cos(yaw) - left * np.sin(yaw), forward * np.sin(yaw) + left * np.cos(yaw), 0 * yaw], axis=1
    )
    step = np.asarray(state.step)
    return Disturbance(
        push=push,
        push_start=step,
        push_stop=step + np.int32(push_steps),
        delay=np.array([trial.delay for trial in trials], np.int32),
        terrain=np.array([trial.terrain for trial in trials], float),
    )


def placed(subject: Subject, starts: Walker, trials: Sequence[Trial]) -> Walker:
    """The robots as which the trials start, [B]; those on terrain are carried onto its crest."""
    height = np.array([trial.terrain for trial in trials])
    offset = np.stack([CREST_X_M * (height > 0), np.zeros_like(height), height], axis=1)
    return carried(subject, take(starts, np.array([trial.start for trial in trials])), offset)


def carried(subject: Subject, walker: Walker, offset: np.ndarray) -> Walker:
    """Robots carried by `offset` [B, 3], m, in the world, with all that they and the engine remember."""
    state, memory = walker
    qpos, history = np.array(state.qpos), np.array(state.history)
    qpos[:, :3] += offset
    history[:, :, :3] += offset[:, None]
    return Walker(replace(state, qpos=qpos, history=history), subject.carried(memory, offset))


def decide(subject: Subject, physics: Physics, walker: Walker, disturbance: Disturbance) -> tuple[Array, Memory]:
    """PD targets [B, 10], rad, of robots that see their state as old as `disturbance` has it, and the next memory."""
    qpos, qvel = delayed(walker.physics, disturbance)
    target, memory = subject.act(physics, replace(walker.physics, qpos=qpos, qvel=qvel), walker.memory)
    # What a robot with NaN in its state wants does not matter any more.
    xp = namespace(qpos)
    return xp.nan_to_num(xp.asarray(target, qpos.dtype)), memory


def take(tree: Any, index: np.ndarray) -> Any:
    """Robots `index` of a pytree with the axis B first, as NumPy arrays."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[index], tree)
