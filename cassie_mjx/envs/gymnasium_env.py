"""Gymnasium's views of the walking task, one robot or many, on MuJoCo C.

envs = gymnasium.make_vec("CassieMJX/Walk-v0", num_envs=64, speed="1x")
"""

from collections.abc import Iterable
from operator import itemgetter
from typing import Any

import jax
import mujoco
import numpy as np

from cassie_mjx.envs.config import WalkConfig
from cassie_mjx.envs.make import make_env
from cassie_mjx.envs.types import WalkState
from cassie_mjx.robot import cassie
from cassie_mjx.robot.drawing import load_scene, open_renderer, place
from cassie_mjx.robot.ground import Ground

try:
    import gymnasium
except ImportError as error:
    raise ImportError("Gymnasium's view needs the package gymnasium; pip install 'cassie-mjx[gymnasium]'.") from error
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

WIDTH, HEIGHT = 640, 480
"""Of frames, pixels."""

Infos = dict[str, Any]


class GymnasiumEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One robot. Actions are residuals on the reference's joint angles, rad; beyond +-1 they are not clipped.

    The info of a step has the terms of the reward, unweighted, both rewards, and 0 or 1 for each cause of an end.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 1 / cassie.CONTROL_PERIOD_S}  # noqa: RUF012

    def __init__(
        self,
        render_mode: str | None = None,
        speed: str = "1x",
        config: WalkConfig | str = "undisturbed",
        physics_hz: int = 1000,
        motion: str = "walk",
    ) -> None:
        """Make the robot. Arguments as those of `make_env`; `render_mode` is "rgb_array" for frames.

        Raises:
          ValueError: one of these is not known or out of its range.
        """
        self.render_mode = _checked(render_mode)
        self._robots = _Robots(1, speed, config, physics_hz, motion)
        self._drawn: WalkState | None = None
        self.observation_space, self.action_space = self._robots.spaces

    def reset(self, *, seed: int | None = None, options: Infos | None = None) -> tuple[np.ndarray, Infos]:
        """A new episode near the reference motion; of one seed always the same."""
        super().reset(seed=seed)
        self._drawn = state = self._robots.reset(self.np_random)
        return _copied(state.observation)[0], {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, Infos]:
        """One control step of 32 ms."""
        after = self._robots.step(np.asarray(action)[None])
        terminated, truncated = bool(after.terminated[0]), bool(after.truncated[0])
        # The task has begun the next episode already; until `reset`, the last moment of this one is shown.
        self._drawn = self._drawn if terminated or truncated else after
        info = {name: float(values[0]) for name, values in after.metrics.items()}
        return _copied(after.final_observation)[0], float(after.reward[0]), terminated, truncated, info

    def render(self) -> np.ndarray | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """A frame [480, 640, 3], uint8, if `render_mode` is "rgb_array"; of the last moment before an end."""
        return self._robots.frames(self._drawn or self._robots.state)[0] if self.render_mode else None

    def close(self) -> None:
        """Close the renderers; a process that ends with open ones complains."""
        self._robots.close()


class GymnasiumVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Robots side by side, stepped together; actions and infos as those of `GymnasiumEnv`.

    A robot whose episode ends starts the next one in the same step: its observation is the first of that one,
    `final_obs` the last of the other, and its info is in `final_info`, as in `SyncVectorEnv` with that mode.
    """

    metadata = {  # noqa: RUF012
        "render_modes": ["rgb_array"],
        "render_fps": 1 / cassie.CONTROL_PERIOD_S,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        render_mode: str | None = None,
        speed: str = "1x",
        config: WalkConfig | str = "undisturbed",
        physics_hz: int = 1000,
        motion: str = "walk",
    ) -> None:
        """Make `num_envs` robots; the other arguments are those of `GymnasiumEnv`.

        Raises:
          ValueError: one of these is not known or out of its range.
        """
        if num_envs < 1:
            raise ValueError(f"num_envs={num_envs} must be at least 1.")
        self.num_envs, self.render_mode = num_envs, _checked(render_mode)
        self._robots = _Robots(num_envs, speed, config, physics_hz, motion)
        self.single_observation_space, self.single_action_space = self._robots.spaces
        self.observation_space, self.action_space = (batch_space(space, num_envs) for space in self._robots.spaces)

    def reset(self, *, seed: int | None = None, options: Infos | None = None) -> tuple[np.ndarray, Infos]:
        """New episodes near the reference motion; of one seed always the same."""
        super().reset(seed=seed)
        return _copied(self._robots.reset(self.np_random).observation), {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Infos]:
        """One control step of 32 ms for each robot."""
        after = self._robots.step(np.asarray(actions))
        terminated, truncated = np.array(after.terminated), np.array(after.truncated)
        ended = terminated | truncated
        infos = _masked(after.metrics, ~ended)
        if ended.any():
            final = zip(ended, _copied(after.final_observation), strict=True)
            infos |= {"final_obs": _objects(seen if over else None for over, seen in final), "_final_obs": ended}
            infos |= {"final_info": _masked(after.metrics, ended), "_final_info": ended.copy()}
        return _copied(after.observation), np.array(after.reward, float), terminated, truncated, infos

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A frame [480, 640, 3], uint8, of each robot, if `render_mode` is "rgb_array"."""
        return self._robots.frames(self._robots.state) if self.render_mode else None

    def close_extras(self) -> None:
        """Close the renderers; a process that ends with open ones complains."""
        self._robots.close()


class _Robots:
    """The task with what Gymnasium has no place for: its state, its random key and its renderers."""

    def __init__(self, robots: int, speed: str, config: WalkConfig | str, physics_hz: int, motion: str) -> None:
        self._env = make_env(speed, robots, "native", physics_hz, config, motion)
        self._state: WalkState | None = None
        self._renderers: dict[tuple[float, ...], Any] = {}
        inputs = self._env.law.observation.size
        self.spaces = Box(-np.inf, np.inf, (inputs,), np.float32), Box(-1.0, 1.0, (cassie.NU,), np.float32)

    @property
    def state(self) -> WalkState:
        if self._state is None:
            raise ResetNeeded("The robots are nowhere yet; call reset() first.")
        return self._state

    def reset(self, random: np.random.Generator) -> WalkState:
        reset_key, self._step_key = jax.random.split(jax.random.key(int(random.integers(2**31))))
        self._state, self._steps = self._env.reset(reset_key), 0
        return self._state

    def step(self, actions: np.ndarray) -> WalkState:
        expected = (self._env.robots, cassie.NU)
        if actions.shape != expected:
            raise ValueError(f"An action of shape {actions.shape} was given; {expected[0]} robots take {expected}.")
        # MuJoCo would put zeros in their place, and the robots would walk on.
        if not np.isfinite(actions).all():
            lost = np.flatnonzero(~np.isfinite(actions).all(axis=1)).tolist()
            raise ValueError(f"The actions of robots {lost} are not finite; the learner has diverged.")
        before = self.state
        key = jax.random.fold_in(self._step_key, self._steps)
        self._state, self._steps = self._env.step(before, actions.astype(np.float32), key), self._steps + 1
        return self._state

    def frames(self, state: WalkState) -> tuple[np.ndarray, ...]:
        grounds = jax.tree.map(np.asarray, state.scenario.ground)
        each = (jax.tree.map(itemgetter(robot), grounds) for robot in range(self._env.robots))
        return tuple(map(self._frame, np.asarray(state.physics.qpos), each))

    def _frame(self, qpos: np.ndarray, ground: Ground) -> np.ndarray:
        # A renderer has the ground that it was opened with; there are few.
        key = tuple(np.hstack(jax.tree.leaves(ground)).tolist())
        if key not in self._renderers:
            scene = load_scene(ground)
            self._renderers[key] = open_renderer(scene, WIDTH, HEIGHT), mujoco.MjData(scene)
        renderer, data = self._renderers[key]
        place(renderer, data, qpos, "three-quarter", ground)
        return renderer.render()

    def close(self) -> None:
        for renderer, _ in self._renderers.values():
            renderer.close()
        self._renderers.clear()


def _checked(render_mode: str | None) -> str | None:
    if render_mode not in (None, "rgb_array"):
        raise ValueError(
            f"render_mode={render_mode!r} is not known; choose rgb_array, or watch a policy with cassie_mjx.view."
        )
    return render_mode


def _copied(values: Any) -> np.ndarray:
    """As an array of the caller's own, for JAX's cannot be written to."""
    return np.array(values, np.float32)


def _objects(values: Iterable[Any]) -> np.ndarray:
    """An array of objects, [B], whatever they are."""
    values = list(values)
    objects = np.empty(len(values), object)
    for i, value in enumerate(values):
        objects[i] = value
    return objects


def _masked(metrics: dict[str, Any], mask: np.ndarray) -> Infos:
    """Metrics where `mask` is, [B], each with the mask beside it, as Gymnasium has infos of vectors."""
    values = {name: np.where(mask, np.asarray(metric, float), 0.0) for name, metric in metrics.items()}
    return values | {f"_{name}": mask.copy() for name in metrics}
