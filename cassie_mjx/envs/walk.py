"""The walking task: `reset` and `step` of a batch of robots, the same on both engines.

Here an engine and the task meet: `task` says where episodes begin and what is seen, `outcome` what a step has led to.
"""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cassie_mjx.envs import command
from cassie_mjx.envs.command import CommandRange
from cassie_mjx.envs.config import WalkConfig
from cassie_mjx.envs.outcome import METRICS, post_physics
from cassie_mjx.envs.scenario import draw_scenario, first_level
from cassie_mjx.envs.task import SCENARIO_KEY, Task
from cassie_mjx.envs.types import StartOffset, WalkState
from cassie_mjx.motion.command import STRAIGHT, Command, Steering
from cassie_mjx.motion.reference import ReferenceMotion
from cassie_mjx.physics.types import Physics, Scenario, merge, sensed, to_backend
from cassie_mjx.robot.arrays import Array
from cassie_mjx.robot.dynamics import Dynamics


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
        self.commands, self.law = CommandRange(speeds, steering), config.law(motion)
        arrays = {name: jnp.asarray(getattr(motion, name), jnp.float32) for name in ("qpos", "qvel", "stride_length")}
        self.motion = motion._replace(**arrays)
        model = physics.model
        share = model.body_mass / model.body_mass.sum()
        self.task = Task(config, self.motion, self.law, self.commands, model.opt.timestep, share)
        self._substeps = self.task.substeps
        longest = config.delay_steps(self.task.physics_hz)
        if longest > physics.max_delay:
            raise ValueError(
                f"scenario.delay_s={config.scenario.delay_s:g} with dynamics={config.dynamics} is up to {longest} "
                f"physics steps; this engine was made for 0 to {physics.max_delay}."
            )
        self._target = jax.jit(self.task.target)
        self._outcome = jax.jit(partial(post_physics, self.task))
        self._start = jax.jit(self.task.start)

    def reset(self, key: jax.Array, level: Array | None = None) -> WalkState:
        """Robots near the reference motion: phase, command, offset from it and scenario are drawn at random.

        Args:
          key: used up here.
          level: of the curriculum, [B]; the one that training begins with unless given.
        """
        level = first_level(self.config.scenario, self.robots) if level is None else jnp.asarray(level, jnp.float32)
        time, told, offset = self.task.draw(key, level)
        scenario = Scenario.nominal(self.robots, kd_scale=np.asarray(self.config.kd_scale))
        if self.config.draws:
            config, scenario_key = self.config, jax.random.fold_in(key, SCENARIO_KEY)
            scenario = draw_scenario(
                config.scenario,
                scenario_key,
                self.robots,
                self.task.physics_hz,
                config.kd_scale,
                level,
                config.span,
            )
        return replace(self.reset_at(time, scenario, told, offset, key), push_level=level)

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
            metrics=dict.fromkeys(METRICS, zeros),
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
        # A velocity beyond single precision has diverged: it becomes infinite, and ends the episode like a NaN.
        with np.errstate(over="ignore"):
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
