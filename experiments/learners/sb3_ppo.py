"""Stable-Baselines3's PPO on our Gymnasium view: `python -m experiments.learners.sb3_ppo run_dir=FOLDER`.

The settings are those that its authors tuned for a biped that walks, `Walker2DBulletEnv-v0` in `hyperparams/ppo.yml` of
DLR-RM/rl-baselines3-zoo, unchanged: 16 robots, and a clip range that falls linearly over 2 million samples.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from stable_baselines3 import PPO  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.callbacks import BaseCallback  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.vec_env import VecEnv, VecNormalize  # pyright: ignore[reportMissingImports]
from torch import nn  # pyright: ignore[reportMissingImports]

from cassie_mjx import cli
from cassie_mjx.control.network import Network, normalize, perceptron
from cassie_mjx.envs.gymnasium_env import GymnasiumVectorEnv
from cassie_mjx.robot import cassie
from cassie_mjx.robot.arrays import Array
from experiments.learners.meter import Meter, PeerConfig

ROBOTS, STEPS, SAMPLES = 16, 512, 2_000_000
SETTINGS = {
    "n_steps": STEPS,
    "batch_size": 128,
    "n_epochs": 20,
    "gamma": 0.99,
    "gae_lambda": 0.9,
    "ent_coef": 0.0,
    "vf_coef": 0.5,
    "max_grad_norm": 0.5,
    "learning_rate": 3e-5,
    "clip_range": lambda left: 0.4 * left,
    "use_sde": True,
    "sde_sample_freq": 4,
    "policy_kwargs": {
        "log_std_init": -2,
        "ortho_init": False,
        "activation_fn": nn.ReLU,
        "net_arch": {"pi": [256, 256], "vf": [256, 256]},
    },
}


class Robots(VecEnv):
    """Our vector environment as Stable-Baselines3 knows them."""

    render_mode = None

    def __init__(self, robots: int, physics_hz: int, seed: int) -> None:
        """Make `robots` robots on MuJoCo C at `physics_hz`; what they are put through comes from `seed`."""
        self._robots = GymnasiumVectorEnv(robots, physics_hz=physics_hz)
        self._seed: int | None = seed
        self._actions = np.zeros((robots, cassie.NU))
        super().__init__(robots, self._robots.single_observation_space, self._robots.single_action_space)

    def reset(self) -> np.ndarray:
        """Observations [B, 80] of new episodes."""
        observation, _ = self._robots.reset(seed=self._seed)
        self._seed = None
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Take the actions [B, 10] of the next step."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Observations [B, 80], rewards [B], whether an episode ended [B], and the last observations of those."""
        observation, reward, terminated, truncated, infos = self._robots.step(self._actions)
        ended = terminated | truncated
        told: list[dict[str, Any]] = [{} for _ in ended]
        for i in np.flatnonzero(ended):
            told[i] = {"terminal_observation": infos["final_obs"][i], "TimeLimit.truncated": bool(truncated[i])}
        return observation, reward.astype(np.float32), ended, told

    def close(self) -> None:
        """Close the robots."""
        self._robots.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute of each robot."""
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Robots have no attributes of their own. Raises NotImplementedError."""
        raise NotImplementedError(attr_name)

    def env_method(self, method_name: str, *_: Any, **__: Any) -> list[Any]:
        """Robots have no methods of their own. Raises NotImplementedError."""
        raise NotImplementedError(method_name)

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Robots are not wrapped."""
        return [False for _ in self._get_indices(indices)]


class Measuring(BaseCallback):
    """Measures the policy every `every` samples, before the rollout that begins there, and ends after `last`."""

    def __init__(self, meter: Meter, every: int, last: int) -> None:
        """Take what measures, how often, and when to end, in samples."""
        super().__init__()
        self._meter, self._every, self._last, self._done = meter, every, last, False

    def _on_step(self) -> bool:
        return not self._done

    def _on_rollout_start(self) -> None:
        samples = self.num_timesteps
        if samples and samples % self._every == 0:
            self._meter.measure(samples, act, network_of(self.model))
            self._done = samples >= self._last

    def _on_training_end(self) -> None:
        self._on_rollout_start()


def network_of(model: Any) -> Network:
    """The actor of a model whose robots' observations are normalised."""
    statistics, policy = model.get_vec_normalize_env(), model.policy
    linear = [layer for layer in policy.mlp_extractor.policy_net if isinstance(layer, nn.Linear)] + [policy.action_net]
    layers = [tuple(x.detach().cpu().numpy() for x in (layer.weight.T, layer.bias)) for layer in linear]
    mean, variance = statistics.obs_rms.mean, statistics.obs_rms.var
    std = np.sqrt(variance + statistics.epsilon)
    return Network(mean.astype(np.float32), std.astype(np.float32), statistics.clip_obs, layers)


def act(network: Network, observation: Array) -> Array:
    """The deterministic action [B, 10]: the mean, cut to the range of actions."""
    inputs = normalize(observation, network.mean, network.std, network.clip)
    return jnp.clip(perceptron(network.layers, inputs), -1.0, 1.0)


def make_model(config: PeerConfig) -> Any:
    """The learner before its first step."""
    robots = VecNormalize(Robots(ROBOTS, config.physics_hz, config.seed), gamma=SETTINGS["gamma"])
    return PPO("MlpPolicy", robots, seed=config.seed, device="cpu", **SETTINGS)


def main(config: PeerConfig) -> None:
    """Train, and measure on the way."""
    iteration = ROBOTS * STEPS
    every = max(1, round(config.every / iteration)) * iteration
    meter = Meter(config)
    make_model(config).learn(max(SAMPLES, config.samples), callback=Measuring(meter, every, config.samples))


if __name__ == "__main__":
    cli.run(main, PeerConfig)
