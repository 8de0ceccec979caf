"""Brax's PPO on our Brax environment: `python -m experiments.learners.brax_ppo run_dir=FOLDER`.

The settings are those of Brax's own humanoid (`notebooks/training.ipynb` of google/brax), with two that follow from the
task: the minibatches are smaller by as much as the robots are fewer, so that a robot takes 160 control steps an
iteration there and here; and rewards are not scaled, for a step of ours earns 0 to 1, as the humanoid's does when
scaled.
"""

from collections.abc import Callable
from typing import Any

import jax
from brax import envs
from brax.training.agents.ppo import train as ppo

import cassie_mjx.envs.brax_env  # noqa: F401
from cassie_mjx import cli
from cassie_mjx.evaluation.returns import EPISODE_STEPS
from cassie_mjx.robot.arrays import Array
from experiments.learners.meter import Act, Meter, PeerConfig

PUBLISHED_ROBOTS, PUBLISHED_BATCH = 2048, 1024
MINIBATCHES, UNROLL = 32, 10
SETTINGS = {
    "num_minibatches": MINIBATCHES,
    "unroll_length": UNROLL,
    "num_updates_per_batch": 8,
    "discounting": 0.97,
    "learning_rate": 3e-4,
    "entropy_cost": 1e-3,
    "normalize_observations": True,
    "action_repeat": 1,
}


def batch_size(robots: int) -> int:
    """Unrolls in a minibatch. Raises ValueError for an odd number of robots, which Brax cannot share out."""
    if robots % 2:
        raise ValueError(f"robots={robots} is odd; Brax's settings need an even number.")
    return robots * PUBLISHED_BATCH // PUBLISHED_ROBOTS


def main(config: PeerConfig) -> None:
    """Train, and measure on the way."""
    batch = batch_size(config.robots)
    env = envs.get_environment("cassie_walk", physics_hz=config.physics_hz)
    iteration = batch * MINIBATCHES * UNROLL
    every = max(1, round(config.every / iteration)) * iteration
    times = -(-config.samples // every)
    meter, acts = Meter(config), dict[Any, Act]()

    def measure(samples: int, make_policy: Callable[..., Any], params: Any) -> None:
        if samples:
            meter.measure(samples, acts.setdefault(make_policy, _deterministic(make_policy)), params)

    ppo.train(
        environment=env,
        num_envs=config.robots,
        batch_size=batch,
        episode_length=EPISODE_STEPS,
        num_timesteps=times * every,
        num_evals=times + 1,
        run_evals=False,
        policy_params_fn=measure,
        seed=config.seed,
        **SETTINGS,
    )


def _deterministic(make_policy: Callable[..., Any]) -> Act:
    def act(params: Any, observation: Array) -> Array:
        action, _ = make_policy(params, deterministic=True)(observation, jax.random.key(0))
        return action

    return act


if __name__ == "__main__":
    cli.run(main, PeerConfig)
