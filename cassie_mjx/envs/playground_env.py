"""MuJoCo Playground's view of the walking task on MJX: one robot, for Playground's wrappers and trainers to batch.

Importing this module registers it: `mujoco_playground.registry.load("CassieWalk", config_overrides={"speed": "2x"})`.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from typing import Any, cast

import jax
import jax.numpy as jnp
import mujoco

from cassie_mjx.envs.config import WalkConfig
from cassie_mjx.envs.make import find_config, make_env
from cassie_mjx.envs.scenario import ScenarioConfig
from cassie_mjx.envs.types import WalkState
from cassie_mjx.robot import cassie
from cassie_mjx.robot.drawing import load_scene
from cassie_mjx.robot.model import xml_path

try:
    from mujoco_playground import MjxEnv, State, locomotion  # pyright: ignore[reportMissingImports]
except ImportError as error:
    sentence = "Playground's view needs the package playground; pip install 'cassie-mjx[playground]'."
    raise ImportError(sentence) from error
from ml_collections import ConfigDict
from mujoco import mjx

NAME = "CassieWalk"


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PlaygroundData(WalkState):
    """A `WalkState` of one robot with the names of `mjx.Data` that Playground draws from.

    All that a robot carries is here, and nothing but the random key in `State.info`: wrappers that start an episode
    anew bring back the data, and leave the info as it is.
    """

    @property
    def qpos(self) -> jax.Array:
        """[35]."""
        return self.physics.qpos[0]

    @property
    def qvel(self) -> jax.Array:
        """[32]."""
        return self.physics.qvel[0]

    @property
    def mocap_pos(self) -> jax.Array:
        """Of no body, [0, 3]."""
        return jnp.zeros((0, 3))

    @property
    def mocap_quat(self) -> jax.Array:
        """Of no body, [0, 4]."""
        return jnp.zeros((0, 4))

    @property
    def xfrc_applied(self) -> jax.Array:
        """The push, [26, 6], N, world frame."""
        forces = jnp.zeros((len(cassie.BODIES), 6))
        return forces.at[cassie.PELVIS_BODY, :3].set(self.scenario.force(self.physics.step)[0])


def default_config(preset: str = "undisturbed") -> ConfigDict:
    """The arguments of `make_env`, and under `walk` the task's parameters, those of a preset.

    An episode's length is that of Playground's `EpisodeWrapper`, so `walk.episode_steps` is not there.

    Raises:
      ValueError: there is no such preset.
    """
    walk = asdict(find_config(preset))
    del walk["episode_steps"]
    config = {"ctrl_dt": cassie.CONTROL_PERIOD_S, "sim_dt": 0.001, "speed": "1x", "motion": "walk", "walk": walk}
    return ConfigDict(config)


class CassiePlaygroundEnv(MjxEnv):
    """The walking task on MJX as an environment of Playground."""

    def __init__(self, config: ConfigDict | None = None, config_overrides: Mapping[str, Any] | None = None) -> None:
        """Compile the robot.

        Args:
          config: as `default_config()`, which it is unless given.
          config_overrides: on top, by dotted name, such as {"walk.symmetric": False}.

        Raises:
          ValueError: a value is not known or out of its range.
        """
        super().__init__(config or default_config(), dict(config_overrides or {}))
        given = self._config
        if given.ctrl_dt != cassie.CONTROL_PERIOD_S:
            raise ValueError(f"ctrl_dt={given.ctrl_dt} is not Cassie's; leave it at {cassie.CONTROL_PERIOD_S}.")
        if not given.sim_dt > 0 or not math.isclose(1 / given.sim_dt, round(1 / given.sim_dt)):
            raise ValueError(f"sim_dt={given.sim_dt} is no whole number of steps a second; use 0.002, 0.001 or 0.0005.")
        self._walk = make_env(given.speed, 1, "mjx", round(1 / given.sim_dt), _walk_config(given.walk), given.motion)

    def reset(self, rng: jax.Array) -> State:
        """A robot near the reference motion, as `rng` has it drawn."""
        reset_key, step_key = jax.random.split(rng)
        return self._view(self._walk.reset(reset_key), {"rng": step_key})

    def step(self, state: State, action: jax.Array) -> State:
        """One control step of 32 ms; `action` [10] is the residual on the reference angles (`WalkEnv.step`), rad."""
        key, next_key = jax.random.split(state.info["rng"])
        walked = self._walk.step(cast(WalkState, state.data), action[None], key)
        after = self._view(walked, state.info | {"rng": next_key})
        return after.replace(metrics=state.metrics | after.metrics)

    @property
    def xml_path(self) -> str:
        """The MJCF of the scene."""
        return str(xml_path("flat"))

    @property
    def action_size(self) -> int:
        """Ten."""
        return cassie.NU

    @cached_property
    def mj_model(self) -> mujoco.MjModel:
        """The scene with all that is for the eyes; it is drawn, not stepped."""
        scene = load_scene()
        scene.opt.timestep = self.sim_dt
        return scene

    @property
    def mjx_model(self) -> mjx.Model:
        """What a randomization_fn is given, in vain: see `_mjx_model`."""
        return mjx.put_model(self._walk.physics.model)

    @property
    def _mjx_model(self) -> None:
        return None

    @_mjx_model.setter
    def _mjx_model(self, model: mjx.Model | None) -> None:
        if model is not None:
            raise ValueError(
                "CassieWalk steps a model of its own, so a randomization_fn would change nothing; for robots that "
                "differ, set ranges of walk.scenario."
            )

    def _view(self, walk: WalkState, info: dict[str, Any]) -> State:
        named = PlaygroundData(**{field.name: getattr(walk, field.name) for field in fields(WalkState)})
        return State(
            data=cast(mjx.Data, named),
            obs=walk.final_observation[0],
            reward=walk.reward[0],
            done=walk.terminated[0].astype(jnp.float32),
            metrics={name: values[0] for name, values in walk.metrics.items()},
            info=info,
        )


def _walk_config(given: ConfigDict) -> WalkConfig:
    values = given.to_dict()
    scenario = ScenarioConfig(**values.pop("scenario"))
    return replace(WalkConfig(**values, scenario=scenario), episode_steps=2**30)


locomotion.register_environment(NAME, CassiePlaygroundEnv, default_config)
