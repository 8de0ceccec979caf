"""What tests need of observations, and policies that observe them."""

import jax
import jax.numpy as jnp
import numpy as np

from cassie_mjx.agents.policy_file import save_policy
from cassie_mjx.control.law import ControlLaw, canonicalize, decanonicalize, second_step
from cassie_mjx.control.observation import OBSERVATIONS, Seen
from cassie_mjx.motion.files import load_motion
from cassie_mjx.motion.reference import sample
from cassie_mjx.ppo import learner, normalizer
from cassie_mjx.ppo.config import PPOConfig
from cassie_mjx.robot import cassie

FULL, SENSORS = OBSERVATIONS["full"], OBSERVATIONS["sensors"]


def lived(steps):
    """What robots go through near the reference, and with which reference ahead: qpos, qvel, qpos ahead, qvel ahead."""
    motion, rng = load_motion("walk"), np.random.default_rng(0)
    qpos, qvel = (np.array(states, float) for states in sample(motion, np.arange(steps)))
    qpos += 0.1 * rng.normal(size=qpos.shape)
    qvel += 0.5 * rng.normal(size=qvel.shape)
    return qpos, qvel, *sample(motion, np.arange(steps) + 1)


def save_sensing_policy(path):
    """Write a symmetric policy of random weights that observes `SENSORS`, with residuals of some tenths of a rad."""
    states = Seen(*lived(300))
    observed = jnp.asarray(SENSORS.update(SENSORS.init(states), states)[0], jnp.float32)
    policy = learner.init(jax.random.key(0), PPOConfig(actor_output_scale=0.3), SENSORS.size, cassie.NU, 1).policy
    policy = policy._replace(normalizer=normalizer.update(policy.normalizer, observed))
    save_policy(path, policy, load_motion("walk"), 1.0, 1.0, {}, law=ControlLaw(SENSORS, symmetric=True))


def observe(qpos, qvel, reference_qpos, reference_qvel):
    """Observations [B, 80]."""
    seen = Seen(qpos, qvel, reference_qpos, reference_qvel)
    return FULL.update(FULL.init(seen), seen)[0]


def canonical(observation, reference_qpos):
    """Observations as a symmetric policy gets them."""
    return canonicalize(FULL, observation, second_step(reference_qpos))


def in_both_steps(act, reference_qpos):
    """The policy of both steps that does in the second, as in a mirror, what `act` does in the first."""
    return lambda observation: np.asarray(
        decanonicalize(act(canonical(observation, reference_qpos)), second_step(reference_qpos))
    )
