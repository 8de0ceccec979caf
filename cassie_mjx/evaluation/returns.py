"""The return that every learning curve and headline figure is made of: undisturbed walking, deterministic policy."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from cassie_mjx.envs.walk import WalkConfig, WalkEnv
from cassie_mjx.motion.reference import ReferenceMotion, nearest_sample
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.physics.types import Disturbance, Physics
from cassie_mjx.robot.model import ModelConfig, load_model

STARTS = 10
EPISODE_STEPS = 300

Act = Callable[[Any], Any]
"""A deterministic policy: observation [B, 80] to action [B, 10]."""


def referee(
    motion: ReferenceMotion, physics: Physics | None = None, speeds: tuple[float, float] = (1.0, 1.0)
) -> WalkEnv:
    """The task that returns are measured on: ten robots, an episode ended by a fall alone.

    Args:
      motion: what to imitate.
      physics: the engine; MuJoCo C at 2 kHz unless given.
      speeds: lowest and highest factor on the motion's speed; the ten robots have ten from the one to the other.
    """
    physics = physics or NativePhysics(load_model(ModelConfig(physics_hz=2000)))
    config = WalkConfig(episode_steps=EPISODE_STEPS, command_s=None, damping=physics.damping).to_the_fall()
    return WalkEnv(physics, motion, config, STARTS, speeds)


def walk_returns(act: Act, env: WalkEnv, disturbance: Disturbance | None = None) -> dict[str, float]:
    """Walk one episode from each of the phases k/B of the stride; rewards after a fall are 0.

    Args:
      act: the policy.
      env: B robots of an environment whose episodes only a fall or the time limit ends (`referee`).
      disturbance: what the robots walk under from the first step on; nothing unless given.

    Returns:
      Means over the B starts: `return_plain`, `return_weighted`, and `steps` survived, of `env.config.episode_steps`.

    Raises:
      ValueError: the environment ends episodes early, which would count as falls.
    """
    if env.config.ends_early:
        raise ValueError("Returns are measured without early ends; use the configuration's to_the_fall().")
    phase = nearest_sample(np.arange(env.robots) / env.robots, env.samples) % env.samples
    state = env.reset_at(phase, disturbance or Disturbance.none(env.robots))
    walking = np.ones(env.robots, bool)
    phase_key = jax.random.key(0)  # of robots that walk on after a fall, which count no more
    sums = {
        "return_plain": np.zeros(env.robots),
        "return_weighted": np.zeros(env.robots),
        "steps": np.zeros(env.robots),
    }
    for _ in range(env.config.episode_steps):
        state = env.step(state, np.asarray(act(state.observation)), phase_key)
        for reward in ("plain", "weighted"):
            sums[f"return_{reward}"] += walking * np.asarray(state.metrics[reward])
        walking &= ~np.asarray(state.terminated)
        sums["steps"] += walking
        if not walking.any():
            break
    return {name: float(values.mean()) for name, values in sums.items()}
