"""What can be evaluated: heuristic walkers, trained policies and blends of them, each as a `Subject` of the sweeps."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cassie_mjx import controller, interpolate, robot
from cassie_mjx.config import speed_factor
from cassie_mjx.controller import CONTROLLERS, ControllerConfig, ControllerState
from cassie_mjx.envs import observation
from cassie_mjx.export import find, learner_policy, shipped_policies
from cassie_mjx.interpolate import SCHEDULES, Progress
from cassie_mjx.model import CONTROL_PERIOD_S, standing
from cassie_mjx.numpy_policy import NumpyPolicy
from cassie_mjx.physics.types import Array, BodyState, Disturbance, Physics, PhysicsState
from cassie_mjx.ppo import networks
from cassie_mjx.reference import ReferenceMotion, nearest_sample, sample, stretch
from cassie_mjx.returns import EPISODE_STEPS, STARTS, referee, walk_returns
from cassie_mjx.trials import Measured, NeverSteady, Subject, Walker, carried, decide, fallen

CONTROLLER_PREFIX, BLEND_PREFIX = "controller:", "blend:"
WARM_UP_STRIDES = 9


@dataclass(frozen=True)
class SubjectConfig:
    """What walks: the first keys of a command that has one subject."""

    policy: str = "1x"
    """What walks: a policy that we ship, a policy's .npz file, a run's directory (its best policy), "controller:stiff",
    "controller:compliant", or "blend:" and two or more policies with commas between."""
    speed: str | None = None
    """Speed at which a policy is told to walk, such as "2.5x"; null for its own, 1x if it was trained at any."""
    schedule: str | None = None
    """How a blend changes: "ramp", to its last policy and back in time, or "adaptive", against the loss of speed."""

    def subject(self) -> Subject:
        """The subject of these names; see `resolve`."""
        return resolve(self.policy, self.speed, self.schedule)


def resolve(name: str, speed: str | None = None, schedule: str | None = None) -> Subject:
    """The subject of that name: a policy, a blend of policies, or a controller.

    Args:
      name: a policy that we ship, its .npz file or a training run's directory; "blend:POLICY,POLICY,...", two or
        more; "controller:NAME".
      speed: at which a policy is told to walk, such as "2.5x"; None for the one it was trained at, 1x if at any.
      schedule: how a blend goes from its first policy to its last, one of `SCHEDULES`.

    Raises:
      ValueError: there is no such subject, or two; it takes no such speed or schedule; or its file is damaged.
    """
    if name.startswith(BLEND_PREFIX) != (schedule is not None):
        known = " or ".join(SCHEDULES)
        raise ValueError(f"policy={name} with schedule={schedule}: a blend, and nothing else, takes schedule={known}.")
    if speed is not None and name.startswith((BLEND_PREFIX, CONTROLLER_PREFIX)):
        raise ValueError(f"policy={name} with speed={speed}: a single policy takes a speed, and nothing else does.")
    if schedule is not None:
        return BlendSubject([resolve_policy(part) for part in name.removeprefix(BLEND_PREFIX).split(",")], schedule)
    preset = name.removeprefix(CONTROLLER_PREFIX)
    if name.startswith(CONTROLLER_PREFIX) and preset in CONTROLLERS:
        return ControllerSubject(preset)
    return resolve_policy(name, speed)


def resolve_policy(name: str, speed: str | None = None) -> "PolicySubject":
    """The policy of that name, told to walk at `speed`; see `resolve`."""
    path = find(name)
    if path is None:
        known = ", ".join([*shipped_policies(), *(CONTROLLER_PREFIX + preset for preset in CONTROLLERS)])
        raise ValueError(f"policy={name} is none of {known}, nor a policy's .npz file, nor a run's directory.")
    return PolicySubject(name, NumpyPolicy.load(path), speed)


def walked(
    subject: Subject, physics: Physics, walker: Walker, disturbance: Disturbance | None = None
) -> Iterator[Walker]:
    """Robots that walk on without end, as they are before each act; undisturbed by default."""
    disturbance = disturbance or Disturbance.none(len(walker.physics.qpos))
    act_steps = round(subject.period_s / physics.model.opt.timestep)
    while True:
        yield walker
        target, memory = decide(subject, physics, walker, disturbance)
        walker = Walker(physics.advance(walker.physics, target, disturbance, act_steps), memory)


def side_by_side(subject: Subject, walkers: Sequence[Walker]) -> Walker:
    """The robots of all `walkers` in one batch, the first walker's first, each carried back to x = 0."""
    together = jax.tree.map(lambda *leaves: np.concatenate(leaves), *walkers)
    return carried(subject, together, -together.physics.qpos[:, :3] * np.array([1.0, 0.0, 0.0]))


def copied_along(subject: Subject, physics: Physics, walker: Walker, calls: np.ndarray) -> Walker:
    """One robot walks on, and a copy of it is taken before each of the acts `calls` [B], counted from 0, back at x = 0.

    Raises:
      NeverSteady: it falls before it walks steadily.
    """
    walk = enumerate(islice(walked(subject, physics, walker), calls.max() + 1))
    taken = {call: walker for call, walker in walk if call in calls}
    walkers = side_by_side(subject, [taken[call] for call in calls.tolist()])
    if fallen(walkers.physics.qpos, np.zeros(len(calls))).any():
        raise NeverSteady(f"{subject.name} falls before it walks steadily, so there is nothing to measure.")
    return walkers


class ControllerMemory(NamedTuple):
    """What a robot of a `ControllerSubject` carries: leaves [B]."""

    config: ControllerConfig
    state: ControllerState


class ControllerSubject:
    """Heuristic walkers as a `Subject`; phase 0 of their stride is where the left leg takes over.

    Every robot carries its parameters with it, so that robots of different parameters can walk side by side.
    """

    def __init__(self, name: str, config: ControllerConfig | None = None) -> None:
        """Take the controller `name` of `CONTROLLERS`.

        Args:
          name: of the preset, which also gives period and step time.
          config: other parameters than the preset's; leaves [B] for the B robots of `begin`, or [].
        """
        self.name, self.damping = CONTROLLER_PREFIX + name, 1.0
        self.provenance: Mapping[str, Any] = {}
        preset = CONTROLLERS[name]
        self.config = config or preset
        self.period_s = preset.period
        self.stride_calls = 2 * round(preset.step_time / preset.period)

    def begin(self, physics: Physics, qpos: np.ndarray, qvel: np.ndarray) -> Walker:
        """Robots that begin to walk from the states qpos [B, 35] and qvel [B, 32]."""
        state = physics.init(qpos, qvel)
        config = jax.tree.map(lambda leaf: np.broadcast_to(np.float32(leaf), len(qpos)), self.config)
        return Walker(state, ControllerMemory(config, controller.init(config, state.qpos, physics.bodies(state))))

    def stand(self, physics: Physics, robots: int) -> Walker:
        """Robots that begin to walk from standing still."""
        return self.begin(physics, np.tile(standing(physics.model), (robots, 1)), np.zeros((robots, robot.NV)))

    def calls_before(self, stride: int) -> int:
        """Acts between `begin` and phase 0 of a stride: the walk begins with half a step on the right leg."""
        return self.stride_calls // 4 + stride * self.stride_calls

    def start(self, physics: Physics, phases: np.ndarray) -> Walker:
        """See `Subject.start`: one robot walks nine strides from standing, and is copied along the tenth."""
        calls = self.calls_before(WARM_UP_STRIDES) + nearest_sample(phases, self.stride_calls)
        return copied_along(self, physics, self.stand(physics, 1), calls)

    def returns(self, physics: Physics, delay: int = 0) -> list[Measured]:
        """See `Subject.returns`: a controller imitates nothing, so it has none."""
        return []

    def act(self, physics: Physics, seen: PhysicsState, memory: ControllerMemory) -> tuple[Array, ControllerMemory]:
        """See `Subject.act`."""
        return _controller_act(memory, seen.qpos, seen.qvel, physics.bodies(seen), self.period_s)

    def carried(self, memory: ControllerMemory, offset: np.ndarray) -> ControllerMemory:
        """See `Subject.carried`."""
        along = offset * np.array([1.0, 1.0, 0.0])
        state = memory.state
        return memory._replace(state=replace(state, liftoff_w=state.liftoff_w + offset, line_w=state.line_w + along))


@jax.jit
def _controller_act(
    memory: ControllerMemory, qpos: Array, qvel: Array, bodies: BodyState, period_s: float
) -> tuple[Array, ControllerMemory]:
    target, state = controller.step(memory.config, memory.state, qpos, qvel, bodies, period_s)
    return target, memory._replace(state=state)


class PolicySubject:
    """A trained policy, deterministic, as a `Subject`; its memory is the sample of the reference it is at, [B]."""

    period_s = CONTROL_PERIOD_S

    def __init__(self, name: str, saved: NumpyPolicy, speed: str | None = None) -> None:
        """Take a saved policy, and a speed at which it is told to walk, if not its own.

        Raises:
          ValueError: it was made for another layout of the observation or for gains that no engine of ours has, or its
            reference cannot have that speed.
        """
        self.damping = float(saved.d_gain[0] / robot.D_GAIN[0])
        if not (np.allclose(saved.d_gain, self.damping * robot.D_GAIN) and np.allclose(saved.p_gain, robot.P_GAIN)):
            raise ValueError(f"policy={name} has PD gains other than the published ones with all D scaled alike.")
        self.name, self.provenance = name if speed is None else f"{name} speed={speed}", saved.provenance
        policy = learner_policy(saved)
        self.motion = ReferenceMotion(
            jnp.asarray(saved.reference_qpos, jnp.float32),
            jnp.asarray(saved.reference_qvel, jnp.float32),
            jnp.asarray(saved.reference_stride_length, jnp.float32),
        )
        if speed is not None and speed_factor(speed) != saved.speed:
            if saved.speed == 0:
                raise ValueError(f"policy={name} with speed={speed}: a reference at 0x has no speed to be stretched.")
            self.motion = stretch(self.motion, speed_factor(speed) / saved.speed)
        mode = partial(networks.mode, policy)
        self.mode = jax.jit(observation.symmetric(mode) if saved.mirror else mode)
        self._target = jax.jit(self._pd_target)

    def start(self, physics: Physics, phases: np.ndarray) -> Walker:
        """See `Subject.start`: one robot walks nine strides from the reference, and is copied along the tenth."""
        samples = len(self.motion.qpos)
        qpos, qvel = sample(self.motion, np.zeros(1, int), np.zeros(1, int))
        walker = Walker(physics.init(np.asarray(qpos, float), np.asarray(qvel, float)), np.zeros(1, np.int32))
        steps = samples * WARM_UP_STRIDES + nearest_sample(phases, samples)
        return copied_along(self, physics, walker, steps)

    def returns(self, physics: Physics, delay: int = 0) -> list[Measured]:
        """See `Subject.returns`."""
        disturbance = replace(Disturbance.none(STARTS), delay=np.full(STARTS, delay, np.int32))
        figures = walk_returns(self.mode, referee(self.motion, physics), disturbance)
        unit = f"of {EPISODE_STEPS}"
        return [Measured(name, figures[name], unit, STARTS) for name in ("return_plain", "return_weighted")]

    def act(self, physics: Physics, seen: PhysicsState, memory: np.ndarray) -> tuple[Array, np.ndarray]:
        """See `Subject.act`."""
        return self._target(seen.qpos, seen.qvel, memory), (memory + 1) % len(self.motion.qpos)

    def carried(self, memory: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """See `Subject.carried`: a policy remembers no place."""
        return memory

    def _pd_target(self, qpos: Array, qvel: Array, phase: Array) -> jax.Array:
        ahead, ahead_velocity = sample(self.motion, phase + 1, jnp.zeros_like(phase))
        action = self.mode(observation.build(qpos, qvel, ahead, ahead_velocity))
        return ahead[:, robot.ACTIVE_QPOS] + action


class BlendSubject:
    """A chain of policies, blended as a schedule says, as a `Subject`; it starts in the first policy's walk."""

    period_s = CONTROL_PERIOD_S

    def __init__(self, policies: Sequence[PolicySubject], schedule: str) -> None:
        """Take policies and the name of one of `SCHEDULES`.

        Raises:
          ValueError: the policies cannot be blended, or not by this schedule, or it is not known.
        """
        self.policies, self.motions = policies, [policy.motion for policy in policies]
        self.speeds = [interpolate.mean_speed(motion) for motion in self.motions]
        self.name = f"{BLEND_PREFIX}{','.join(policy.name for policy in policies)} schedule={schedule}"
        self.provenance = {policy.name: policy.provenance for policy in policies}
        interpolate.check_chain(self.motions)
        self.damping = policies[0].damping
        if any(policy.damping != self.damping for policy in policies):
            raise ValueError(f"{self.name}: its policies have D gains of their own, so that no one PD law holds both.")
        if schedule not in SCHEDULES:
            raise ValueError(f"schedule={schedule} is not known; choose one of {', '.join(SCHEDULES)}.")
        if schedule == "adaptive" and (np.diff(self.speeds) <= 0).any():
            raise ValueError(f"{self.name} goes by speed; name its policies from the slowest to the fastest.")
        self._schedule = SCHEDULES[schedule]
        self._act = jax.jit(self._blended)

    def start(self, physics: Physics, phases: np.ndarray) -> Walker:
        """See `Subject.start`."""
        state, phase = self.policies[0].start(physics, phases)
        return Walker(state, Progress(phase, 0 * phase, np.full(len(phase), self.speeds[0], np.float32)))

    def returns(self, physics: Physics, delay: int = 0) -> list[Measured]:
        """See `Subject.returns`: a blend imitates no one motion, so it has none."""
        return []

    def act(self, physics: Physics, seen: PhysicsState, memory: Progress) -> tuple[Array, Progress]:
        """See `Subject.act`."""
        return self._act(seen.qpos, seen.qvel, memory)

    def carried(self, memory: Progress, offset: np.ndarray) -> Progress:
        """See `Subject.carried`: a blend remembers no place."""
        return memory

    def position(self, memory: Progress) -> Array:
        """Where along the chain robots are, [B], 0 for the first policy."""
        return self._schedule(memory, self.speeds)

    def _blended(self, qpos: Array, qvel: Array, memory: Progress) -> tuple[Array, Progress]:
        memory = replace(memory, speed=interpolate.filtered(memory.speed, qvel[:, 0]))
        ahead = memory.phase + 1
        modes = [policy.mode for policy in self.policies]
        target = interpolate.pd_target(modes, self.motions, self.position(memory), ahead, qpos, qvel)
        return target, replace(memory, phase=ahead % len(self.motions[0].qpos), step=memory.step + 1)
