"""Brax's view of the walking task: one robot, for Brax's wrappers and any Brax-style trainer to batch.

Importing this module registers it: `brax.envs.get_environment("cassie_walk", speed="2x")`.
"""

from dataclasses import dataclass, fields, replace
from typing import Any, cast

import jax
import jax.numpy as jnp
import mujoco
from brax import base, envs
from brax.envs.base import PipelineEnv, State
from brax.io import mjcf

from cassie_mjx.envs.config import WalkConfig
from cassie_mjx.envs.make import find_config
from cassie_mjx.envs.types import WalkState
from cassie_mjx.envs.walk import WalkEnv
from cassie_mjx.motion.command import speed_factor
from cassie_mjx.motion.files import load_motion
from cassie_mjx.motion.reference import ReferenceMotion, stretch
from cassie_mjx.physics.make import make_physics
from cassie_mjx.robot.model import MJX_TRAINING, ModelConfig, steps_per_control, xml_path


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PipelineState(WalkState):
    """A `WalkState` of one robot with the names that Brax renders from."""

    @property
    def q(self) -> jax.Array:
        """Qpos, [35]."""
        return self.physics.qpos[0]

    @property
    def qd(self) -> jax.Array:
        """Qvel, [32]."""
        return self.physics.qvel[0]


class CassieEnv(PipelineEnv):
    """The walking task on MJX as a Brax environment.

    The reference phase is part of `pipeline_state`, so it is batched, reset and restored with the rest. Episodes end
    here by falls, low rewards and distance from the reference; their full length is the `episode_length` of Brax's
    `EpisodeWrapper`.
    """

    def __init__(
        self, motion: ReferenceMotion, config: WalkConfig | None = None, model: ModelConfig = MJX_TRAINING
    ) -> None:
        """Compile the robot.

        Args:
          motion: what to imitate.
          config: the task's parameters, `episode_steps` excepted; the default is `WalkConfig()`.
          model: rate, contacts and solver of the physics.

        Raises:
          ValueError: the task draws scenarios; Brax hands a step no key to draw them with.
        """
        if config is not None and config.draws:
            raise ValueError(
                f"scenario={config.scenario} and dynamics={config.dynamics} are not for CassieEnv, for Brax hands a "
                "step no random key; train with cassie_mjx.train, or without scenarios."
            )
        # Brax asks for a system of its own; it serves for rendering and sizes, not for stepping.
        scene = mujoco.MjModel.from_xml_path(str(xml_path("flat")))
        scene.opt.timestep = 1 / model.physics_hz
        super().__init__(mjcf.load_model(scene), backend="mjx", n_frames=steps_per_control(model.physics_hz))
        endless = replace(config or WalkConfig(), episode_steps=2**30)
        physics = make_physics("mjx", replace(model, electronics=endless.electronics))
        self._walk = WalkEnv(physics, motion, endless, robots=1)

    @property
    def sys(self) -> base.System:
        """What Brax renders, and reads sizes from; it is not stepped."""
        return self._sys

    @sys.setter
    def sys(self, sys: base.System) -> None:
        if sys is not getattr(self, "_sys", sys):
            raise ValueError(
                "CassieEnv does not step `sys`, so a randomization_fn would change nothing; for robots that differ, "
                "train with cassie_mjx.train and the ranges of walk.scenario."
            )
        self._sys = sys

    def reset(self, rng: jax.Array) -> State:
        """A robot near the reference motion, at a phase and a velocity drawn with `rng`."""
        return self._view(self._walk.reset(rng))

    def step(self, state: State, action: jax.Array) -> State:
        """One control step of 32 ms; `action` [10] is the residual on the reference angles (`WalkEnv.step`), rad."""
        # Brax's AutoResetWrapper starts the next episode, so the start that the task itself would draw is never used.
        walked = self._walk.step(cast(WalkState, state.pipeline_state), action[None], jax.random.PRNGKey(0))
        after = self._view(walked)
        return state.replace(
            pipeline_state=after.pipeline_state,
            obs=after.obs,
            reward=after.reward,
            done=after.done,
            metrics=state.metrics | after.metrics,
        )

    def _view(self, walk: WalkState) -> State:
        named = PipelineState(**{field.name: getattr(walk, field.name) for field in fields(WalkState)})
        return State(
            pipeline_state=cast(base.State, named),
            obs=walk.final_observation[0],
            reward=walk.reward[0],
            done=walk.terminated[0].astype(jnp.float32),
            metrics={name: values[0] for name, values in walk.metrics.items()},
        )


def cassie_walk(
    speed: str = "1x", config: WalkConfig | str = "undisturbed", physics_hz: int = 1000, motion: str = "walk"
) -> CassieEnv:
    """A `CassieEnv` by the arguments of `make_env`.

    Raises:
      ValueError: one of these is not known or out of its range, or the task draws scenarios.
    """
    walked = stretch(load_motion(motion), speed_factor(speed))
    return CassieEnv(walked, find_config(config), replace(MJX_TRAINING, physics_hz=physics_hz))


# Brax calls what it has under a name, a class or not.
envs.register_environment("cassie_walk", cast(Any, cassie_walk))
