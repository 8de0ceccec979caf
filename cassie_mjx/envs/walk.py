"""The walking task: `reset` and `step` of a batch of robots, the same on both engines.

Xie et al. 2018: every 32 ms a policy sees robot and reference and adds a residual to the reference angles of the ten
active joints (`control.law`). The reward says how near the robot stays to the reference motion.
"""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cassie_mjx.control import command as motions
from cassie_mjx.control.command import MotionState
from cassie_mjx.control.law import second_step, target
from cassie_mjx.control.observation import OBSERVATIONS, Seen
from cassie_mjx.control.path import Path, into, out_of
from cassie_mjx.envs import command, privileged, reward
from cassie_mjx.envs.command import CommandRange
from cassie_mjx.envs.config import WalkConfig
from cassie_mjx.envs.scenario import draw_scenario, first_level, is_disturbed, next_level, renew_scenario
from cassie_mjx.envs.start import draw_offset
from cassie_mjx.envs.termination import Ends, ends
from cassie_mjx.envs.types import Start, StartOffset, StepOutcome, WalkState
from cassie_mjx.motion.command import STRAIGHT, Command, Steering
from cassie_mjx.motion.reference import ReferenceMotion
from cassie_mjx.physics.types import Physics, Scenario, merge, sensed, to_backend
from cassie_mjx.robot import cassie
from cassie_mjx.robot.arrays import Array
from cassie_mjx.robot.dynamics import Dynamics, encoded
from cassie_mjx.robot.ground import Ground, height_below
from cassie_mjx.robot.model import steps_per_control

# What the key of a step or reset is folded with for all but phases, which it draws as it is: `randint` splits it in
# two, and folding with 0 or 1 would give those halves again.
_SPEED_KEY, _SCENARIO_KEY, _VELOCITY_KEY, _COMMAND_KEY, _OFFSET_KEY, _NOISE_KEY, _FRESH_NOISE_KEY = range(2, 9)


class WalkEnv:
    """The task on one engine. `reset` and `step` can be traced where the engine can; else they run on the host."""

    def __init__(
        self,
        physics: Physics,
        motion: ReferenceMotion,
        config: WalkConfig,
        robots: int,
        speeds: tuple[float, float] = (1.0, 1.0),
        steering: Steering = STRAIGHT,
    ) -> None:
        """Bind task and engine.

        Args:
          physics: the engine; its timestep must divide the control step.
          motion: what to imitate.
          config: the task's parameters.
          robots: B, robots side by side.
          speeds: lowest and highest factor on the motion's speed.
          steering: how far robots are steered off straight ahead.

        Raises:
          ValueError: the engine is made for shorter delays than the task draws, or `config.symmetric` is true and the
            motion's second step is not the mirror image of its first.
        """
        self.physics, self.config, self.robots = physics, config, robots
        self.commands = CommandRange(speeds, steering)
        self.law = config.law(motion)
        # Mean time between commanded speeds, s; None if every episode has one alone.
        self._command_s = config.command_s if speeds[0] < speeds[1] else None
        arrays = {name: jnp.asarray(getattr(motion, name), jnp.float32) for name in ("qpos", "qvel", "stride_length")}
        self.motion = motion._replace(**arrays)
        self.samples = motion.qpos.shape[0]
        self._physics_hz = round(1 / physics.model.opt.timestep)
        self._substeps = steps_per_control(self._physics_hz)
        self._timestep = physics.model.opt.timestep
        longest = config.delay_steps(self._physics_hz)
        if longest > physics.max_delay:
            raise ValueError(
                f"scenario.delay_s={config.scenario.delay_s:g} with dynamics={config.dynamics} is up to {longest} "
                f"physics steps; this engine was made for 0 to {physics.max_delay}."
            )
        self._target = jax.jit(self._pd_target)
        self._outcome = jax.jit(self._post_physics)
        self._start = jax.jit(self._start_states)

    def reset(self, key: jax.Array) -> WalkState:
        """Robots near the reference motion: phase, command, offset from it and scenario are drawn at random."""
        time, told, offset = self._draw(key, self.robots)
        scenario = Scenario.nominal(self.robots, kd_scale=np.asarray(self.config.kd_scale))
        if self.config.draws:
            config, scenario_key = self.config, jax.random.fold_in(key, _SCENARIO_KEY)
            scenario = draw_scenario(
                config.scenario,
                scenario_key,
                self.robots,
                self._physics_hz,
                config.kd_scale,
                first_level(config.scenario, self.robots),
                config.span,
            )
        return self.reset_at(time, scenario, told, offset, key)

    def reset_at(
        self,
        time: Array,
        scenario: Scenario,
        told: Command | None = None,
        offset: StartOffset | None = None,
        key: jax.Array | None = None,
    ) -> WalkState:
        """Robots on the reference motion or a little off it, in `scenario`; on terrain above a crest.

        Args:
          time: control step of the motion that they start at, [B].
          scenario: what acts on them from now on.
          told: their commands; straight ahead, evenly from the lowest to the highest speed, unless given.
          offset: from the reference; none unless given.
          key: for the noise on the first observation; no noise unless given.
        """
        robots = len(time)
        if self.config.span and scenario.dynamics is None:
            scenario = replace(scenario, dynamics=Dynamics.nominal(robots))
        if told is None:
            factor = np.linspace(*self.commands.speeds, robots, dtype=np.float32)
            told = command.command_of(self.motion, jnp.asarray(factor))
        offset = StartOffset(np.zeros((robots, 2)), np.zeros((robots, 2))) if offset is None else offset
        start = self._start(jnp.asarray(time, jnp.int32), told, offset, scenario, key)
        physics = self.physics.init(start.qpos, start.qvel)
        if self.config.electronics != (physics.electronics is not None):
            raise ValueError(
                f"electronics={self.config.electronics} is not what this engine was made for; make it with "
                f"ModelConfig(electronics={self.config.electronics})."
            )
        zeros, ended = jnp.zeros(robots), jnp.zeros(robots, bool)
        metrics = {name: zeros for name in (*reward.SCALES, *reward.Terms._fields, *Ends._fields)}
        return WalkState(
            physics=physics,
            scenario=to_backend(physics, scenario),
            motion=start.motion,
            sensing=start.sensing,
            push_level=first_level(self.config.scenario, robots),
            observation=start.observation,
            final_observation=start.observation,
            privileged=start.privileged,
            final_privileged=start.privileged,
            reward=zeros,
            terminated=ended,
            truncated=ended,
            metrics=metrics,
        )

    def step(self, state: WalkState, action: Array, key: jax.Array) -> WalkState:
        """One control step of 32 ms; robots whose episode ends start anew, as `reset` draws them.

        Where speeds are commanded on the way, they go on at theirs. A task without scenarios of its own leaves those
        that `reset_at` was given as they are.

        Args:
          state: before the step.
          action: of the policy for `state.observation`, [B, 10], rad (`ControlLaw.target`).
          key: for new episodes, for commanded speeds, for scenarios and for noise on what is observed.
        """
        held = to_backend(state.physics, self._target(state.motion, action))
        physics = self.physics.advance(state.physics, held, state.scenario, self._substeps)
        seen = sensed(physics, state.scenario)
        outcome = self._outcome(
            state.motion, state.sensing, state.push_level, state.scenario, physics.qpos, physics.qvel, *seen, key
        )
        fresh = self.physics.init(outcome.start.qpos, outcome.start.qvel)
        ended = outcome.terminated | outcome.truncated
        given: dict[str, Any] = outcome._asdict()
        given.pop("start")
        # What is not drawn keeps its precision, which it would lose in the compiled part.
        scenario = given["scenario"] if self.config.draws else state.scenario
        given["scenario"] = to_backend(physics, scenario)
        return WalkState(physics=merge(to_backend(physics, ended), fresh, physics), **given)

    def _pd_target(self, state: MotionState, action: jax.Array) -> jax.Array:
        reference, _ = motions.reference(self.motion, state, ahead=1)
        return target(reference, self.law.residual(reference, action))

    def _draw(self, key: jax.Array, robots: int) -> tuple[jax.Array, Command, StartOffset]:
        """Phase [robots], command and offset from the reference of new episodes.

        `robots` is a device's share of the B robots if there are several.
        """
        time = jax.random.randint(key, (robots,), 0, self.samples)
        told = command.draw_command(self.motion, jax.random.fold_in(key, _SPEED_KEY), robots, self.commands)
        velocity_key, place_key = (jax.random.fold_in(key, number) for number in (_VELOCITY_KEY, _OFFSET_KEY))
        return time, told, draw_offset(self.config, velocity_key, place_key, robots)

    def _noise(self, key: jax.Array | None, robots: int) -> Array:
        """Noise on what one control step adds to the observation, [robots, F]."""
        width = self.law.observation.noise
        if key is None or not width.any():
            return 0.0
        return width * jax.random.uniform(key, (robots, len(width)), minval=-1.0)

    def _observe(
        self, state: MotionState, sensing: jax.Array | None, qpos: jax.Array, qvel: jax.Array, key: jax.Array | None
    ) -> tuple[jax.Array, jax.Array]:
        """What the policy sees of robots at qpos [B, 35] and qvel [B, 32], [B, O], and what the observation carries on.

        `sensing` is what it carries, None as an episode begins; without a key there is no noise.
        """
        ahead = motions.reference(self.motion, state, ahead=1)
        seen = Seen(*into(state.path, qpos, qvel), *ahead, state.command)
        carry = self.law.init(seen) if sensing is None else sensing
        return self.law.observe(carry, seen, self._noise(key, len(qpos)))

    def _start_states(
        self,
        time: jax.Array,
        told: Command,
        offset: StartOffset,
        scenario: Scenario,
        key: jax.Array | None,
    ) -> Start:
        speed = jnp.linalg.norm(jnp.asarray(offset.velocity), axis=1)
        state = command.start_motion(self.motion, time, told, scenario.ground, speed)
        qpos, qvel = motions.reference(self.motion, state)
        qpos = qpos.at[:, cassie.PELVIS_POSITION[:2]].add(offset.position)
        qpos = qpos.at[:, cassie.PELVIS_Z].add(scenario.ground.sine)
        qvel = qvel.at[:, cassie.HORIZONTAL_VELOCITY].add(offset.velocity)
        qpos, qvel = out_of(state.path, qpos, qvel)
        noise_key = None if key is None else jax.random.fold_in(key, _FRESH_NOISE_KEY)
        observation, sensing = self._observe(state, None, encoded(qpos, scenario.dynamics), qvel, noise_key)
        known = self._privileged(state, scenario, offset.position[:, 0], qpos, qvel)
        return Start(qpos, qvel, state, observation, sensing, known)

    def _post_physics(
        self,
        before: MotionState,
        sensing: jax.Array,
        push_level: jax.Array,
        scenario: Scenario,
        qpos: jax.Array,
        qvel: jax.Array,
        sensed_qpos: jax.Array,
        sensed_qvel: jax.Array,
        key: jax.Array,
    ) -> StepOutcome:
        """Reward, ends, and what comes next, for robots that physics has taken to qpos [B, 35] and qvel [B, 32]."""
        state = motions.tick(self.motion, before)
        reference = motions.reference(self.motion, state)
        in_world = out_of(state.path, *reference)
        nan = ~(jnp.isfinite(qpos).all(axis=1) & jnp.isfinite(qvel).all(axis=1))
        qpos, qvel, sensed_qpos, sensed_qvel = merge(
            nan, (*in_world, *in_world), (qpos, qvel, sensed_qpos, sensed_qvel)
        )
        walked = self._on_the_path(state.path, qpos, qvel, scenario.ground)
        rewards, terms = self._rewards(walked, self._paid(state, reference[0]), nan)
        earned = jnp.where(nan, 0.0, reward.total(terms))
        lead, aside = ((walked - reference[0])[:, axis] for axis in (cassie.PELVIS_X, cassie.PELVIS_Y))
        causes = self._ends(nan, walked[:, cassie.PELVIS_Z], earned, lead, aside)
        terminated = jnp.stack(causes).any(axis=0)
        truncated = ~terminated & self._is_last(state)
        ended = terminated | truncated
        known = self._privileged(state, scenario, lead, qpos, qvel)
        state = self._leashed(state, lead, aside)
        scenario, push_level = self._renew(scenario, push_level, state, terminated, truncated, key)
        state = self._told(state, sensed_qvel, key)
        start = self._begin_anew(state, scenario, key)
        noise_key = jax.random.fold_in(key, _NOISE_KEY)
        observation, sensing = self._observe(state, sensing, sensed_qpos, sensed_qvel, noise_key)
        causes = {name: cause.astype(earned.dtype) for name, cause in causes._asdict().items()}
        return StepOutcome(
            start=start,
            scenario=scenario,
            push_level=push_level,
            motion=merge(ended, start.motion, state),
            observation=merge(ended, start.observation, observation),
            final_observation=observation,
            sensing=merge(ended, start.sensing, sensing),
            privileged=merge(ended, start.privileged, known),
            final_privileged=known,
            reward=earned,
            terminated=terminated,
            truncated=truncated,
            metrics={**rewards, **terms._asdict(), **causes},
        )

    def _on_the_path(self, path: Path, qpos: jax.Array, qvel: jax.Array, ground: Ground) -> jax.Array:
        """World states' qpos [B, 35] in the path's frame and as on flat ground, where the reference walks."""
        height = height_below(ground, qpos[:, cassie.PELVIS_X], qpos[:, cassie.PELVIS_Y])
        return into(path, qpos, qvel)[0].at[:, cassie.PELVIS_Z].add(-height)

    def _paid(self, state: MotionState, reference: jax.Array) -> jax.Array:
        """The reference, qpos [B, 35], that robots are paid for being near to."""
        if self.commands.steering == STRAIGHT:
            return reference
        return motions.reference(self.motion, state._replace(command=command.paid(state)))[0]

    def _rewards(
        self, walked: jax.Array, reference: jax.Array, nan: jax.Array
    ) -> tuple[dict[str, jax.Array], reward.Terms]:
        """Both rewards as they are measured, and the terms that are learned from."""
        terms = {name: reward.terms(scale, walked, reference) for name, scale in reward.SCALES.items()}
        rewards = {name: jnp.where(nan, 0.0, reward.total(values)) for name, values in terms.items()}
        learned = reward.SCALES[self.config.reward]._replace(orientation=self.config.orientation_scale)
        return rewards, reward.terms(learned, walked, reference)

    def _ends(self, nan: jax.Array, height: jax.Array, earned: jax.Array, lead: jax.Array, aside: jax.Array) -> Ends:
        """Why episodes end of robots at a height, `lead` ahead of the reference and `aside` to its left, m, all [B]."""
        # Where robots are steered, one must not do without the position's share of the reward to the side either.
        away = lead if self.commands.steering == STRAIGHT else jnp.maximum(abs(lead), abs(aside))
        return ends(nan, height, earned, away, self.config.min_reward, self.config.max_position_error_m)

    def _is_last(self, state: MotionState) -> jax.Array:
        """Whether this control step is the last of an episode: its time is up, or the motion has ended."""
        timed_out = state.step >= self.config.episode_steps
        return timed_out if self.motion.periodic else timed_out | (state.time >= self.samples - 1)

    def _leashed(self, state: MotionState, lead: jax.Array, aside: jax.Array) -> MotionState:
        """The same moment, with the reference within the leash of disturbed robots; see `motions.follow`."""
        if self.config.leash_m is None:
            return state
        leash_m = jnp.where(is_disturbed(self.config.scenario, len(lead)), self.config.leash_m, jnp.inf)
        return motions.follow(state, lead, aside, leash_m)

    def _renew(
        self,
        scenario: Scenario,
        level: jax.Array,
        state: MotionState,
        terminated: jax.Array,
        truncated: jax.Array,
        key: jax.Array,
    ) -> tuple[Scenario, jax.Array]:
        """What acts on robots from now on, and their levels of the curriculum."""
        config, step = self.config.scenario, state.step * self._substeps
        if not self.config.draws:
            return scenario, level
        level = next_level(config, level, scenario, step, terminated)
        scenario_key = jax.random.fold_in(key, _SCENARIO_KEY)
        ended = terminated | truncated
        hz, span = self._physics_hz, self.config.span
        return renew_scenario(config, scenario_key, scenario, step, ended, hz, level, span), level

    def _told(self, state: MotionState, qvel: jax.Array, key: jax.Array) -> MotionState:
        """The same moment, with the command on its way to a target that may be a new one; qvel [B, 32] is sensed."""
        if self._command_s is None and self.commands.steering == STRAIGHT:
            return state
        if self._command_s is not None:
            target_key = jax.random.fold_in(key, _COMMAND_KEY)
            state = command.redraw_target(self.motion, state, target_key, self.commands, self._command_s)
        return motions.approach(self.motion, state, qvel)

    def _begin_anew(self, state: MotionState, scenario: Scenario, key: jax.Array) -> Start:
        """New episodes, one a robot. Where commands change on the way, they go on with that of the last.

        So how long a speed is walked does not depend on how early its episodes end.
        """
        time, drawn, offset = self._draw(key, len(state.time))
        told = drawn if self._command_s is None else state.command
        start = self._start_states(time, told, offset, scenario, key)
        if self._command_s is None:
            return start
        return start._replace(motion=start.motion._replace(target_command=state.target_command))

    def _privileged(
        self, state: MotionState, scenario: Scenario, lead: Array, qpos: jax.Array, qvel: jax.Array
    ) -> jax.Array:
        """What a critic sees of robots at qpos [B, 35] and qvel [B, 32], `lead` [B], m, ahead of the motion, [B, P].

        Where the policy does not observe the true state, it sees how far that is from the reference. Where the task
        disturbs robots, it sees what disturbs them, and what they are like where robots differ. All of it is in a
        mirror where the policy sees one.
        """
        seen = [privileged.ahead(lead)]
        if self.law.observation is OBSERVATIONS["full"] and not self.config.draws:
            return seen[0]
        reference = motions.reference(self.motion, state, ahead=1)
        mirrored = second_step(reference[0]) & self.law.symmetric
        if self.law.observation is not OBSERVATIONS["full"]:
            walked = self._on_the_path(state.path, qpos, qvel, scenario.ground)
            seen.append(privileged.errors(Seen(walked, into(state.path, qpos, qvel)[1], *reference), mirrored))
        if self.config.draws:
            step = state.step * self._substeps
            seen.append(privileged.disturbances(scenario, step, self._timestep, state.path.heading, mirrored))
            if scenario.dynamics is not None:
                share = self.physics.model.body_mass / self.physics.model.body_mass.sum()
                seen.append(privileged.dynamics(scenario.dynamics, share, self._timestep, mirrored))
        return jnp.concatenate(seen, axis=1)
