"""The walking task: `reset` and `step` of a batch of robots, the same on both engines.

Xie et al. 2018: every 32 ms a policy sees robot and reference and adds a residual to the reference angles of the ten
active joints; the sum is the PD target. The reward says how near the robot stays to the reference motion.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cassie_mjx import robot
from cassie_mjx.envs import observation, reward
from cassie_mjx.envs.types import Clock, WalkState
from cassie_mjx.model import steps_per_control
from cassie_mjx.physics.types import Array, Disturbance, Physics, delayed, merge
from cassie_mjx.reference import ReferenceMotion, sample, stretch_states


@dataclass(frozen=True)
class WalkConfig:
    """The task's own parameters."""

    reward: str = "weighted"
    """Reward to learn from: "plain" (the paper's) or "weighted" (the later code's); both are always measured."""
    early_end_reward: float | None = 0.6
    """A step's reward below which an episode ends, a device of training; null ends it by a fall alone."""
    episode_steps: int = 300
    """Control steps of a full episode; 300 are 9.6 s."""

    def __post_init__(self) -> None:
        """Raise ValueError for a value out of range."""
        if self.reward not in reward.SCALES:
            raise ValueError(f"reward={self.reward!r} is not known; choose one of {', '.join(reward.SCALES)}.")
        if self.early_end_reward is not None and not 0 <= self.early_end_reward < 1:
            raise ValueError(f"early_end_reward={self.early_end_reward} must be from 0 to below 1, or null.")
        if self.episode_steps < 1:
            raise ValueError(f"episode_steps={self.episode_steps} must be at least 1.")


# What the key of a step or reset is folded with for the speeds; as it is, it draws phases.
_SPEED_KEY = 2


class _Judgement(NamedTuple):
    """All of the next `WalkState` but the physics, and where the robots that ended start anew."""

    fresh_qpos: jax.Array
    fresh_qvel: jax.Array
    rest: dict[str, Any]


class WalkEnv:
    """The task on one engine. On MJX `reset` and `step` can be traced; on MuJoCo C they run on the host."""

    def __init__(
        self,
        physics: Physics,
        motion: ReferenceMotion,
        config: WalkConfig,
        robots: int,
        speeds: tuple[float, float] = (1.0, 1.0),
    ) -> None:
        """Bind task and engine.

        Args:
          physics: the engine; its timestep must divide the control step.
          motion: what to imitate.
          config: the task's parameters.
          robots: B, robots side by side.
          speeds: lowest and highest factor on the motion's speed; each episode has one between them.
        """
        self.physics, self.config, self.robots, self.speeds = physics, config, robots, speeds
        self.motion = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), motion)
        self.samples = motion.qpos.shape[0]
        self._substeps = steps_per_control(round(1 / physics.model.opt.timestep))
        self._target = jax.jit(self._pd_target)
        self._judge = jax.jit(self._judge_step)
        self._start = jax.jit(self._start_states)

    def reset(self, key: jax.Array) -> WalkState:
        """Robots on the reference motion, each at a phase and a speed drawn at random, undisturbed."""
        phase, speed = self._draw(key, self.robots)
        return self.reset_at(phase, Disturbance.none(self.robots), speed)

    def reset_at(self, phase: Array, disturbance: Disturbance, speed: Array | None = None) -> WalkState:
        """Robots on the reference motion at the samples `phase` [B] of the stride, under `disturbance`.

        `speed` [B] are factors on the motion's speed; if none are given, they go evenly from the lowest to the highest.
        """
        speed = np.linspace(*self.speeds, len(phase)) if speed is None else speed
        clock, qpos, qvel, seen = self._start(jnp.asarray(phase, jnp.int32), jnp.asarray(speed, jnp.float32))
        physics = self.physics.init(qpos, qvel)
        zeros = jnp.zeros(len(phase))
        ended = jnp.zeros(len(phase), bool)
        metrics = {name: zeros for name in (*_METRICS, *reward.Terms._fields)}
        return WalkState(physics, disturbance, clock, seen, seen, zeros, ended, ended, metrics)

    def step(self, state: WalkState, action: Array, key: jax.Array) -> WalkState:
        """One control step of 32 ms; robots whose episode ends start anew at a phase and speed drawn with `key`.

        Args:
          state: before the step.
          action: residual on the reference angles of the active joints, [B, 10], rad.
          key: for the phases and speeds of new episodes.
        """
        target = self._target(state.clock, action)
        on_host = isinstance(state.physics.qpos, np.ndarray)
        if on_host:
            target = np.asarray(target, float)
        physics = self.physics.advance(state.physics, target, state.disturbance, self._substeps)
        sensed = delayed(physics, state.disturbance)
        judgement = self._judge(state.clock, physics.qpos, physics.qvel, *sensed, state.disturbance.terrain, key)
        ended = judgement.rest["terminated"] | judgement.rest["truncated"]
        physics = merge(
            np.asarray(ended) if on_host else ended,
            self.physics.init(judgement.fresh_qpos, judgement.fresh_qvel),
            physics,
        )
        return WalkState(physics=physics, disturbance=state.disturbance, **judgement.rest)

    def _pd_target(self, clock: Clock, action: jax.Array) -> jax.Array:
        reference, _ = self._reference(clock, ahead=1)
        return reference[:, robot.ACTIVE_QPOS] + action

    def _draw(self, key: jax.Array, robots: int) -> tuple[jax.Array, jax.Array]:
        """Phase and speed of new episodes, each [robots]: of a device's share of the B robots if there are several."""
        phase = jax.random.randint(key, (robots,), 0, self.samples)
        low, high = self.speeds
        speed_key = jax.random.fold_in(key, _SPEED_KEY)
        return phase, jax.random.uniform(speed_key, (robots,), minval=low, maxval=high)

    def _reference(self, clock: Clock, ahead: int = 0) -> tuple[jax.Array, jax.Array]:
        """The motion at each robot's speed, `ahead` control steps from now: (qpos [B, 35], qvel [B, 32])."""
        return stretch_states(*sample(self.motion, clock.phase + ahead, clock.stride), clock.speed)

    def _observe(self, clock: Clock, qpos: jax.Array, qvel: jax.Array) -> jax.Array:
        return observation.build(qpos, qvel, *self._reference(clock, ahead=1))

    def _start_states(self, phase: jax.Array, speed: jax.Array) -> tuple[Clock, jax.Array, jax.Array, jax.Array]:
        zeros = jnp.zeros_like(phase)
        clock = Clock(phase, zeros, zeros, speed)
        qpos, qvel = self._reference(clock)
        return clock, qpos, qvel, self._observe(clock, qpos, qvel)

    def _judge_step(
        self,
        before: Clock,
        qpos: jax.Array,
        qvel: jax.Array,
        sensed_qpos: jax.Array,
        sensed_qvel: jax.Array,
        terrain: jax.Array,
        key: jax.Array,
    ) -> _Judgement:
        clock = self._tick(before)
        reference, reference_velocity = self._reference(clock)
        nan = ~(jnp.isfinite(qpos).all(axis=1) & jnp.isfinite(qvel).all(axis=1))
        qpos, sensed_qpos, sensed_qvel = merge(
            nan, (reference, reference, reference_velocity), (qpos, sensed_qpos, sensed_qvel)
        )

        terms = {name: reward.terms(scale, qpos, reference) for name, scale in reward.SCALES.items()}
        rewards = {name: jnp.where(nan, 0.0, reward.total(values)) for name, values in terms.items()}
        earned = rewards[self.config.reward]
        height = qpos[:, 2] - terrain * jnp.sin(qpos[:, 0])
        fallen = nan | (height < robot.FALL_LOW_M) | (height > robot.FALL_HIGH_M)
        low = jnp.zeros_like(nan) if self.config.early_end_reward is None else earned < self.config.early_end_reward
        terminated = fallen | low
        truncated = ~terminated & (clock.step >= self.config.episode_steps)

        fresh_clock, fresh_qpos, fresh_qvel, fresh_seen = self._start_states(*self._draw(key, len(nan)))
        ended = terminated | truncated
        seen = self._observe(clock, sensed_qpos, sensed_qvel)
        return _Judgement(
            fresh_qpos,
            fresh_qvel,
            {
                "clock": merge(ended, fresh_clock, clock),
                "observation": merge(ended, fresh_seen, seen),
                "final_observation": seen,
                "reward": earned,
                "terminated": terminated,
                "truncated": truncated,
                "metrics": {**rewards, "nan": nan.astype(earned.dtype), "fallen": fallen.astype(earned.dtype)}
                | terms[self.config.reward]._asdict(),
            },
        )

    def _tick(self, clock: Clock) -> Clock:
        phase = clock.phase + 1
        return Clock(phase % self.samples, clock.stride + phase // self.samples, clock.step + 1, clock.speed)


_METRICS = (*reward.SCALES, "nan", "fallen")
