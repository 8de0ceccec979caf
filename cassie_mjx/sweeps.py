"""Trials of a walker, many side by side: what walks, what it is put through, and how it did.

Every lane of the batch is in a trial of its own. A lane whose robot has fallen, or whose trial is over, takes the next
trial at once, so no time goes into robots on the ground.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol, TypeAlias

import jax
import numpy as np

from cassie_mjx import robot
from cassie_mjx.model import CONTROL_PERIOD_S, steps_per_control
from cassie_mjx.physics.types import Array, Disturbance, Physics, PhysicsState, delayed

SPEED_WINDOW_S = 5.0
PUSH_S, AFTER_PUSH_S = 0.2, 4.0
# Terrain begins on a crest, which is level: anywhere else one foot would start inside the slope.
CREST_X_M = np.pi / 2
# The motors' power is sampled at least this often, in physics steps, also between the acts of a slow subject.
SAMPLE_STEPS = 8
SMALLEST_BATCH = 8

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

    def start(self, physics: Physics, phases: np.ndarray) -> Walker:
        """Robots in steady walking along +x, with the pelvis at x = 0, at `phases` [B] of the stride, 0 to 1."""
        ...

    def returns(self) -> list[Measured]:
        """Returns of undisturbed walking, for a subject that imitates a reference motion."""
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
      power_w: mean over time of the motors' positive work rates' sum, W: sum over motors of max(torque x velocity, 0).
    """

    survived_s: np.ndarray
    fell: np.ndarray
    lowest_m: np.ndarray
    height_m: np.ndarray
    speed_mps: np.ndarray
    distance_m: np.ndarray
    drift_m: np.ndarray
    power_w: np.ndarray


Key: TypeAlias = tuple[int, ...]


class Trials(Protocol):
    """Where `conduct` takes its trials from."""

    def next(self) -> tuple[Key, Trial] | None:
        """The next trial to begin and the key that its result goes under; None once there will be no more."""
        ...

    def wanted(self, key: Key) -> bool:
        """Whether the outcome of a trial under way still matters."""
        ...

    def ended(self, key: Key, result: EpisodeResult) -> None:
        """Take the result, its fields scalars, of a trial."""
        ...


Watch: TypeAlias = Callable[[int, int], None]
"""Called after every control step with the number of trials over and of robots walking."""


def fallen(qpos: Array, terrain: Array) -> Array:
    """Whether the pelvis of qpos [..., 35] is less than 0.6 m or more than 1.2 m over the ground below it, or NaN."""
    height = height_over_ground(qpos, terrain)
    return ~((height >= robot.FALL_LOW_M) & (height <= robot.FALL_HIGH_M))


def height_over_ground(qpos: Array, terrain: Array) -> Array:
    """Height of the pelvis of qpos [..., 35] over the terrain z = h sin x below it, m; `terrain` is h, [...], m."""
    return qpos[..., 2] - terrain * np.sin(qpos[..., 0])


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


def take(tree: Any, index: np.ndarray) -> Any:
    """Robots `index` of a pytree with the axis B first, as NumPy arrays."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[index], tree)


def _put(tree: Any, index: np.ndarray, robots: Any) -> Any:
    def put(leaf: Array, new: Array) -> np.ndarray:
        leaf = np.array(leaf)
        leaf[index] = new
        return leaf

    return jax.tree.map(put, tree, robots)


def conduct(
    subject: Subject, physics: Physics, starts: Walker, trials: Trials, lanes: int = 64, watch: Watch | None = None
) -> None:
    """Conduct trials, `lanes` at a time, until there are no more; results go to `trials.ended`.

    Args:
      subject: what walks.
      physics: the engine, at any rate that fits the subject's period.
      starts: walkers that a trial can start as.
      trials: where trials come from and their results go.
      lanes: robots side by side; the batch is halved when half of them have nothing to do.
      watch: told of progress.

    Raises:
      ValueError: the subject's period does not divide the control step into whole physics steps.
    """
    flight, over = _Flight(subject, physics, starts, lanes), 0
    while flight.fill(trials):
        flight.control_step()
        over += flight.land(trials)
        if watch is not None:
            watch(over, sum(job is not None for job in flight.jobs))


def fly(
    subject: Subject, physics: Physics, starts: Walker, trials: Sequence[Trial], watch: Watch | None = None
) -> EpisodeResult:
    """Conduct these trials side by side; results [B] in their order. Arguments as in `conduct`."""
    listed = _Listed(trials)
    conduct(subject, physics, starts, listed, len(trials), watch)
    return jax.tree.map(lambda *values: np.array(values), *(listed.results[i,] for i in range(len(trials))))


class _Listed:
    """Trials that are all known beforehand."""

    def __init__(self, trials: Sequence[Trial]) -> None:
        self.waiting = iter([((index,), trial) for index, trial in enumerate(trials)])
        self.results: dict[Key, EpisodeResult] = {}

    def next(self) -> tuple[Key, Trial] | None:
        return next(self.waiting, None)

    def wanted(self, key: Key) -> bool:
        return True

    def ended(self, key: Key, result: EpisodeResult) -> None:
        self.results[key] = result


class _Flight:
    """The lanes of `conduct`: robots, what disturbs them, and the job (key, trial) of each; a free lane has none."""

    def __init__(self, subject: Subject, physics: Physics, starts: Walker, lanes: int) -> None:
        self.subject, self.physics, self.starts = subject, physics, starts
        hertz = 1 / physics.model.opt.timestep
        self.act_steps = round(subject.period_s * hertz)
        self.acts, rest = divmod(steps_per_control(hertz), max(self.act_steps, 1))
        if rest or not self.acts:
            raise ValueError(f"{subject.name} acts every {subject.period_s:g} s, which does not divide 0.032 s.")
        self.push_steps = round(PUSH_S * hertz)
        self.jobs: list[tuple[Key, Trial] | None] = [None] * lanes
        self.walker, self.disturbance, self.record = self._begin([_IDLE] * lanes)

    def _begin(self, trials: list[Trial]) -> tuple[Walker, Disturbance, "_Record"]:
        walker = placed(self.subject, self.starts, trials)
        late = [trial.control_steps - _window(trial) for trial in trials]
        record = _Record.begin(walker.physics.qpos, np.array(late))
        return walker, disturbances(trials, walker.physics, self.push_steps), record

    def fill(self, trials: Trials) -> bool:
        """Give every free lane a job, or halve the batch; False when no job is left. Lanes still free start over."""
        free = [lane for lane, job in enumerate(self.jobs) if job is None]
        if free:
            for lane in free:
                self.jobs[lane] = trials.next()
            begun = self._begin([self._trial(lane) for lane in free])
            self._set(_put(self._robots(), np.array(free), begun))
        busy = [lane for lane, job in enumerate(self.jobs) if job is not None]
        size = len(self.jobs)
        while size > SMALLEST_BATCH and 2 * len(busy) <= size:
            size //= 2
        if size < len(self.jobs):
            keep = sorted(range(len(self.jobs)), key=lambda lane: self.jobs[lane] is None)[:size]
            self.jobs = [self.jobs[lane] for lane in keep]
            self._set(take(self._robots(), np.array(keep)))
        return bool(busy)

    def control_step(self) -> None:
        """Advance all lanes by 32 ms."""
        state, memory = self.walker
        chunk = math.gcd(self.act_steps, SAMPLE_STEPS)
        power = np.zeros(len(self.jobs))
        for _ in range(self.acts):
            qpos, qvel = delayed(state, self.disturbance)
            target, memory = self.subject.act(self.physics, replace(state, qpos=qpos, qvel=qvel), memory)
            # What a robot with NaN in its state wants does not matter any more.
            target = np.nan_to_num(np.asarray(target, float))
            for _ in range(self.act_steps // chunk):
                state = self.physics.advance(state, target, self.disturbance, chunk)
                power += motor_power(state, target, self.disturbance)
        self.walker = Walker(state, memory)
        power *= chunk / (self.acts * self.act_steps)
        self.record = self.record.update(np.asarray(state.qpos), self.disturbance.terrain, power)

    def land(self, trials: Trials) -> int:
        """Hand in the results of what is over now; returns how many. Lanes with unwanted trials become free, too."""
        fell = fallen(np.asarray(self.walker.physics.qpos), self.disturbance.terrain)
        over = []
        for lane, job in enumerate(self.jobs):
            if job is not None and (fell[lane] or self.record.control_steps[lane] >= job[1].control_steps):
                trials.ended(job[0], self.record.result(lane, job[1], fell[lane]))
                over.append(lane)
        for lane, job in enumerate(self.jobs):
            if lane in over or (job is not None and not trials.wanted(job[0])):
                self.jobs[lane] = None
        return len(over)

    def _trial(self, lane: int) -> Trial:
        job = self.jobs[lane]
        return _IDLE if job is None else job[1]

    def _robots(self) -> tuple[Walker, Disturbance, "_Record"]:
        return self.walker, self.disturbance, self.record

    def _set(self, robots: tuple[Walker, Disturbance, "_Record"]) -> None:
        self.walker, self.disturbance, self.record = robots


_IDLE = Trial(start=0, seconds=0.0)


def _window(trial: Trial) -> int:
    """Control steps over which the speed is taken."""
    return min(round(SPEED_WINDOW_S / CONTROL_PERIOD_S), trial.control_steps)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Record:
    """Sums over each lane's trial so far, [B]."""

    control_steps: np.ndarray
    late_after: np.ndarray  # control steps before the last 5 s
    lowest: np.ndarray
    height: np.ndarray
    power: np.ndarray
    first: np.ndarray  # pelvis x, y at the start, [B, 2]
    late_x: np.ndarray  # pelvis x at the start of the last 5 s, or now if they have not begun
    now: np.ndarray  # pelvis x, y, [B, 2]

    @classmethod
    def begin(cls, qpos: np.ndarray, late_after: np.ndarray) -> "_Record":
        zero, xy = np.zeros(len(qpos)), qpos[:, :2]
        return cls(np.zeros(len(qpos), int), late_after, zero + np.inf, zero, zero, xy, xy[:, 0], xy)

    def update(self, qpos: np.ndarray, terrain: np.ndarray, power: np.ndarray) -> "_Record":
        height = height_over_ground(qpos, terrain)
        steps = self.control_steps + 1
        return replace(
            self,
            control_steps=steps,
            lowest=np.fmin(self.lowest, height),
            height=self.height + height,
            power=self.power + power,
            late_x=np.where(steps <= self.late_after, qpos[:, 0], self.late_x),
            now=qpos[:, :2].copy(),
        )

    def result(self, lane: int, trial: Trial, fell: bool) -> EpisodeResult:
        steps = self.control_steps[lane]
        distance, drift = self.now[lane] - self.first[lane]
        return EpisodeResult(
            survived_s=np.minimum(steps * CONTROL_PERIOD_S, trial.seconds),
            fell=np.array(fell),
            lowest_m=self.lowest[lane],
            height_m=self.height[lane] / steps,
            speed_mps=(self.now[lane, 0] - self.late_x[lane]) / (_window(trial) * CONTROL_PERIOD_S),
            distance_m=distance,
            drift_m=drift,
            power_w=self.power[lane] / steps,
        )


def motor_power(state: PhysicsState, target: Array, disturbance: Disturbance) -> Array:
    """Positive mechanical power of the motors under PD targets [B, 10] (rad), summed over motors, [B], W."""
    qpos, qvel = delayed(state, disturbance)
    torque = robot.pd_torque(target, qpos[:, robot.ACTIVE_QPOS], qvel[:, robot.ACTIVE_QVEL])
    return np.maximum(torque * np.asarray(state.qvel)[:, robot.ACTIVE_QVEL], 0).sum(axis=1)
