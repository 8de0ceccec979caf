"""The walking task: `reset` and `step` of a batch of robots, the same on both engines.

Xie et al. 2018: every 32 ms a policy sees robot and reference and adds a residual to the reference angles of the ten
active joints; the sum is the PD target. The reward says how near the robot stays to the reference motion.
"""

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from cassie_mjx.control import observation
from cassie_mjx.envs import command as clocks
from cassie_mjx.envs import reward
from cassie_mjx.envs.scenario import DisturbanceConfig, draw, renew
from cassie_mjx.envs.types import Clock, WalkState
from cassie_mjx.motion.reference import ReferenceMotion
from cassie_mjx.physics.types import Array, Disturbance, Physics, PhysicsState, delayed, merge
from cassie_mjx.robot import cassie
from cassie_mjx.robot.model import CONTROL_PERIOD_S, steps_per_control


@dataclass(frozen=True)
class WalkConfig:
    """The task's own parameters."""

    reward: str = "weighted"
    """Reward to learn from: "plain" (the paper's) or "weighted" (the later code's); both are always measured."""
    early_end_reward: float | None = 0.4
    """A step's reward below which an episode ends, a device of training; null for none."""
    x_limit_m: float | None = 0.5
    """How far ahead of the reference motion or behind it an episode ends, m, a device of training; null for nowhere.

    Without it robots that are told to walk fast learn to do without the position's share of the reward."""
    episode_steps: int = 300
    """Control steps of a full episode; 300 are 9.6 s."""
    start_velocity_mps: float = 0.5
    """How far from the reference's the pelvis' horizontal velocity may be as an episode begins, m/s, in any direction.

    It is drawn for each episode. Robots learn from it to come back to the speed that they are told, sooner than by
    losing it themselves; 0 starts every episode on the reference, as in the paper."""
    start_offset_m: float = 0.0
    """How far to the left or right of the reference's line an episode may begin, m. It is drawn for each episode."""
    command_s: float | None = 4.0
    """Mean time from one commanded speed to the next, s, where there is a range of them; null for one an episode."""
    damping: float = 1.0
    """Factor on the published D gains of the PD law; with less, robots bear to sense and act later."""
    symmetric: bool = False
    """Whether the policy learns one of the stride's two steps and sees and acts in the other as in a mirror."""
    disturbance: DisturbanceConfig = field(default_factory=DisturbanceConfig)
    """What robots are put through besides walking."""

    def __post_init__(self) -> None:
        """Raise ValueError for a value out of range."""
        if self.reward not in reward.SCALES:
            raise ValueError(f"reward={self.reward!r} is not known; choose one of {', '.join(reward.SCALES)}.")
        if self.early_end_reward is not None and not 0 <= self.early_end_reward < 1:
            raise ValueError(f"early_end_reward={self.early_end_reward} must be from 0 to below 1, or null.")
        if self.x_limit_m is not None and not self.x_limit_m > 0:
            raise ValueError(f"x_limit_m={self.x_limit_m} must be greater than 0, or null.")
        if not 0 <= self.start_velocity_mps <= 3:
            raise ValueError(f"start_velocity_mps={self.start_velocity_mps} must be from 0 to 3.")
        if not 0 <= self.start_offset_m <= 3:
            raise ValueError(f"start_offset_m={self.start_offset_m} must be from 0 to 3.")
        if self.command_s is not None and not self.command_s >= CONTROL_PERIOD_S:
            raise ValueError(f"command_s={self.command_s} must be at least {CONTROL_PERIOD_S}, or null.")
        if self.episode_steps < 1:
            raise ValueError(f"episode_steps={self.episode_steps} must be at least 1.")
        if not 0 <= self.damping <= 1:
            raise ValueError(f"damping={self.damping} must be from 0 to 1.")

    @property
    def ends_early(self) -> bool:
        """Whether an episode can end without a fall before its time."""
        return self.early_end_reward is not None or self.x_limit_m is not None

    def to_the_fall(self) -> "WalkConfig":
        """The same task, but an episode ends by a fall or the time limit alone."""
        return replace(self, early_end_reward=None, x_limit_m=None)


WALK_PRESETS = {
    "undisturbed": WalkConfig(),
    "robust": WalkConfig(
        early_end_reward=None,
        x_limit_m=None,
        start_offset_m=1.0,
        damping=0.3,
        symmetric=True,
        disturbance=DisturbanceConfig(push_n=300, push_pause_s=2, terrain_m=0.25, delay_s=0.01),
    ),
}
"""The task's presets by name; in `robust` only falls end episodes early, for pushed robots stray and earn little."""

T = TypeVar("T")

# What the key of a step or reset is folded with for all but phases, which it draws as it is: `randint` splits it in
# two, and folding with 0 or 1 would give those halves again.
_SPEED_KEY, _DISTURBANCE_KEY, _VELOCITY_KEY, _COMMAND_KEY, _OFFSET_KEY = 2, 3, 4, 5, 6

ENDS = ("nan", "fallen", "low_reward", "strayed")
"""What an episode can end by before its time, as `WalkState.metrics` names it; one can end by several: a NaN is a fall,
too, and earns 0."""

# Unit in which a critic is told how far a robot is ahead: half of what ends an episode, so of the order of 1.
LEAD_M = 0.25


class StartOffset(NamedTuple):
    """How far off the reference motion robots begin."""

    velocity: Array
    """What the pelvis' velocity along x and y is on top of the reference's, [B, 2], m/s."""
    y: Array
    """How far to the left of the reference the pelvis is, [B], m."""

    @classmethod
    def none(cls, robots: int) -> "StartOffset":
        """Robots [B] on the reference."""
        return cls(np.zeros((robots, 2), np.float32), np.zeros(robots, np.float32))


class _Judgement(NamedTuple):
    """All of the next `WalkState` but the physics, and where the robots that ended start anew."""

    fresh_qpos: jax.Array
    fresh_qvel: jax.Array
    disturbance: Disturbance
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
          speeds: lowest and highest factor on the motion's speed.

        Raises:
          ValueError: the engine is made for shorter delays than the task draws, or for another damping than its own.
        """
        self.physics, self.config, self.robots, self.speeds = physics, config, robots, speeds
        # Mean time between commanded speeds, s; None if every episode has one alone.
        self._command_s = config.command_s if speeds[0] < speeds[1] else None
        self.motion = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), motion)
        self.samples = motion.qpos.shape[0]
        self._physics_hz = round(1 / physics.model.opt.timestep)
        self._substeps = steps_per_control(self._physics_hz)
        longest = config.disturbance.delay_steps(self._physics_hz)
        if longest > physics.max_delay:
            raise ValueError(
                f"delay_s={config.disturbance.delay_s:g} is {longest} physics steps; "
                f"this engine was made for 0 to {physics.max_delay}."
            )
        if config.damping != physics.damping:
            raise ValueError(f"damping={config.damping:g} is not that of this engine, {physics.damping:g}.")
        self._target = jax.jit(self._pd_target)
        self._judge = jax.jit(self._judge_step)
        self._start = jax.jit(self._start_states)

    def reset(self, key: jax.Array) -> WalkState:
        """Robots near the reference motion: phase, speed, offset from it and disturbance are drawn at random."""
        phase, speed, offset = self._draw(key, self.robots)
        disturbance = Disturbance.none(self.robots)
        if self.config.disturbance.active:
            disturbance_key = jax.random.fold_in(key, _DISTURBANCE_KEY)
            disturbance = draw(self.config.disturbance, disturbance_key, self.robots, self._physics_hz)
        return self.reset_at(phase, disturbance, speed, offset)

    def reset_at(
        self, phase: Array, disturbance: Disturbance, speed: Array | None = None, offset: StartOffset | None = None
    ) -> WalkState:
        """Robots on the reference motion or a little off it, under `disturbance`; on terrain above a crest.

        Args:
          phase: samples of the stride, [B].
          disturbance: what acts on them from now on.
          speed: factors on the motion's speed, [B]; evenly from the lowest to the highest unless given.
          offset: from the reference; none unless given.
        """
        speed = np.linspace(*self.speeds, len(phase)) if speed is None else speed
        offset = StartOffset.none(len(phase)) if offset is None else offset
        phase, speed = jnp.asarray(phase, jnp.int32), jnp.asarray(speed, jnp.float32)
        clock, qpos, qvel, seen = self._start(phase, speed, offset, disturbance.terrain)
        physics = self.physics.init(qpos, qvel)
        disturbance = _beside(physics, disturbance)
        zeros = jnp.zeros(len(phase))
        ended = jnp.zeros(len(phase), bool)
        metrics = {name: zeros for name in (*reward.SCALES, *reward.Terms._fields, *ENDS)}
        lead = zeros[:, None]
        return WalkState(physics, disturbance, clock, seen, seen, lead, lead, zeros, ended, ended, metrics)

    def step(self, state: WalkState, action: Array, key: jax.Array) -> WalkState:
        """One control step of 32 ms; robots whose episode ends start anew, as `reset` draws them.

        Where speeds are commanded on the way, they go on at theirs. A task without disturbances of its own leaves those
        that `reset_at` was given as they are.

        Args:
          state: before the step.
          action: residual on the reference angles of the active joints, [B, 10], rad; in a symmetric task as in a
            mirror where the reference is in its second step, as the observation was.
          key: for new episodes, for commanded speeds, and for disturbances.
        """
        target = _beside(state.physics, self._target(state.clock, action))
        physics = self.physics.advance(state.physics, target, state.disturbance, self._substeps)
        sensed = delayed(physics, state.disturbance)
        judgement = self._judge(state.clock, state.disturbance, physics.qpos, physics.qvel, *sensed, key)
        ended = judgement.rest["terminated"] | judgement.rest["truncated"]
        fresh = self.physics.init(judgement.fresh_qpos, judgement.fresh_qvel)
        return WalkState(
            physics=merge(_beside(physics, ended), fresh, physics),
            disturbance=_beside(physics, judgement.disturbance),
            **judgement.rest,
        )

    def _pd_target(self, clock: Clock, action: jax.Array) -> jax.Array:
        reference, _ = clocks.reference(self.motion, clock, ahead=1)
        if self.config.symmetric:
            action = observation.unfolded(action, reference[:, observation.HIP_PITCH])
        return reference[:, cassie.ACTIVE_QPOS] + action

    def _draw(self, key: jax.Array, robots: int) -> tuple[jax.Array, jax.Array, StartOffset]:
        """Phase [robots], speed [robots] and offset from the reference of new episodes.

        `robots` is a device's share of the B robots if there are several.
        """
        phase = jax.random.randint(key, (robots,), 0, self.samples)
        speed = clocks.draw_speed(jax.random.fold_in(key, _SPEED_KEY), robots, self.speeds)
        size_key, angle_key = jax.random.split(jax.random.fold_in(key, _VELOCITY_KEY))
        size = jax.random.uniform(size_key, (robots, 1), maxval=self.config.start_velocity_mps)
        angle = jax.random.uniform(angle_key, (robots,), maxval=2 * jnp.pi)
        limit = self.config.start_offset_m
        y = jax.random.uniform(jax.random.fold_in(key, _OFFSET_KEY), (robots,), minval=-limit, maxval=limit)
        return phase, speed, StartOffset(size * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1), y)

    def _observe(self, clock: Clock, qpos: jax.Array, qvel: jax.Array) -> jax.Array:
        seen = observation.build(qpos, qvel, *clocks.reference(self.motion, clock, ahead=1))
        return observation.folded(seen) if self.config.symmetric else seen

    def _start_states(
        self, phase: jax.Array, speed: jax.Array, offset: StartOffset, terrain: jax.Array
    ) -> tuple[Clock, jax.Array, jax.Array, jax.Array]:
        clock = clocks.start(self.motion, phase, speed, terrain)
        qpos, qvel = clocks.reference(self.motion, clock)
        qpos, qvel = qpos.at[:, 1].add(offset.y).at[:, 2].add(terrain), qvel.at[:, :2].add(offset.velocity)
        return clock, qpos, qvel, self._observe(clock, qpos, qvel)

    def _judge_step(
        self,
        before: Clock,
        disturbance: Disturbance,
        qpos: jax.Array,
        qvel: jax.Array,
        sensed_qpos: jax.Array,
        sensed_qvel: jax.Array,
        key: jax.Array,
    ) -> _Judgement:
        clock = clocks.tick(self.motion, before)
        reference, reference_velocity = clocks.reference(self.motion, clock)
        nan = ~(jnp.isfinite(qpos).all(axis=1) & jnp.isfinite(qvel).all(axis=1))
        qpos, sensed_qpos, sensed_qvel = merge(
            nan, (reference, reference, reference_velocity), (qpos, sensed_qpos, sensed_qvel)
        )

        # The reference walks on flat ground: its z counts from the ground below.
        ground = disturbance.terrain * jnp.sin(qpos[:, 0])
        walked = qpos.at[:, 2].add(-ground)
        terms = {name: reward.terms(scale, walked, reference) for name, scale in reward.SCALES.items()}
        rewards = {name: jnp.where(nan, 0.0, reward.total(values)) for name, values in terms.items()}
        earned = rewards[self.config.reward]
        height = walked[:, 2]
        fallen = nan | (height < cassie.FALL_LOW_M) | (height > cassie.FALL_HIGH_M)
        lead = (walked - reference)[:, 0]
        privileged = jnp.clip(lead / LEAD_M, -10, 10)[:, None]
        low = jnp.zeros_like(nan) if self.config.early_end_reward is None else earned < self.config.early_end_reward
        left = jnp.zeros_like(nan) if self.config.x_limit_m is None else abs(lead) > self.config.x_limit_m
        terminated = fallen | low | left
        truncated = ~terminated & (clock.step >= self.config.episode_steps)

        ended = terminated | truncated
        causes = dict(zip(ENDS, (nan, fallen, low, left), strict=True))
        disturbance = self._renew(disturbance, clock, ended, key)
        clock = self._command(clock, key)
        phase, speed, offset = self._draw(key, len(nan))
        # Where speeds are commanded on the way, episodes go on at that of the last: so how long a speed is walked does
        # not depend on how early its episodes end.
        speed = speed if self._command_s is None else clock.speed
        fresh = self._start_states(phase, speed, offset, disturbance.terrain)
        fresh_clock, fresh_qpos, fresh_qvel, fresh_seen = fresh
        if self._command_s is not None:
            fresh_clock = replace(fresh_clock, command=clock.command)
        seen = self._observe(clock, sensed_qpos, sensed_qvel)
        return _Judgement(
            fresh_qpos,
            fresh_qvel,
            disturbance,
            {
                "clock": merge(ended, fresh_clock, clock),
                "observation": merge(ended, fresh_seen, seen),
                "final_observation": seen,
                "privileged": jnp.where(ended[:, None], 0.0, privileged),
                "final_privileged": privileged,
                "reward": earned,
                "terminated": terminated,
                "truncated": truncated,
                "metrics": {**rewards, **terms[self.config.reward]._asdict()}
                | {name: cause.astype(earned.dtype) for name, cause in causes.items()},
            },
        )

    def _renew(self, disturbance: Disturbance, clock: Clock, ended: jax.Array, key: jax.Array) -> Disturbance:
        config = self.config.disturbance
        if not config.active:
            return disturbance
        disturbance_key = jax.random.fold_in(key, _DISTURBANCE_KEY)
        return renew(config, disturbance_key, disturbance, clock.step * self._substeps, ended, self._physics_hz)

    def _command(self, clock: Clock, key: jax.Array) -> Clock:
        if self._command_s is None:
            return clock
        command_key = jax.random.fold_in(key, _COMMAND_KEY)
        return clocks.paced(self.motion, clocks.commanded(clock, command_key, self.speeds, self._command_s))


def _beside(physics: PhysicsState, tree: T) -> T:
    """`tree` where the physics is: as NumPy arrays if the engine runs on the host."""
    return jax.tree.map(np.asarray, tree) if isinstance(physics.qpos, np.ndarray) else tree
