"""What tests need of observations, and policies that observe them."""

import jax
import jax.numpy as jnp
import numpy as np

from cassie_mjx.agents.controller import Controller
from cassie_mjx.agents.make import make_policy_agent
from cassie_mjx.agents.policy_file import save_policy
from cassie_mjx.agents.types import Sensed
from cassie_mjx.control.law import ControlLaw, canonicalize, decanonicalize, second_step
from cassie_mjx.control.observation import OBSERVATIONS, Seen
from cassie_mjx.motion.files import load_motion
from cassie_mjx.motion.reference import sample, stretch
from cassie_mjx.ppo import learner, normalizer
from cassie_mjx.ppo.config import PPOConfig
from cassie_mjx.robot import cassie

FULL, SENSORS, REMEMBERED = (OBSERVATIONS[name] for name in ("full", "sensors", "sensors_history"))


def lived(steps):
    """What robots go through near the reference, and with which reference ahead: qpos, qvel, qpos ahead, qvel ahead."""
    motion, rng = load_motion("walk"), np.random.default_rng(0)
    qpos, qvel = (np.array(states, float) for states in sample(motion, np.arange(steps)))
    qpos += 0.1 * rng.normal(size=qpos.shape)
    qvel += 0.5 * rng.normal(size=qvel.shape)
    return qpos, qvel, *sample(motion, np.arange(steps) + 1)


def sensed_by_steps(steps, terms=SENSORS):
    """What a policy that observes `terms` is given as it lives through that, [steps, O]."""
    observations, carry = [], None
    for step in zip(*lived(steps), strict=True):
        seen = Seen(*(part[None] for part in step))
        observation, carry = terms.update(terms.init(seen) if carry is None else carry, seen)
        observations.append(observation[0])
    return np.array(observations, np.float32)


def save_sensing_policy(path, seed=0, speed=1.0, bias=0.0, terms=SENSORS, **ppo):
    """Write a symmetric policy of random weights that observes `terms`, with residuals of some tenths of a rad."""
    states = Seen(*lived(300))
    observed = jnp.asarray(terms.update(terms.init(states), states)[0], jnp.float32)
    config = PPOConfig(actor_output_scale=0.3, **ppo)
    policy = learner.init(jax.random.key(seed), config, terms.size, cassie.NU, 1).policy
    biased = jax.tree.map(lambda x: x + bias if x.ndim == 1 else x, policy.actor)
    policy = policy._replace(actor=biased, normalizer=normalizer.update(policy.normalizer, observed))
    motion = stretch(load_motion("walk"), speed)
    save_policy(path, policy, motion, speed, 1.0, {}, law=ControlLaw(terms, symmetric=True))


def assert_controller_acts_as_agent(path):
    """A policy on NumPy and on JAX gives the same targets for 300 steps, far from the reference.

    Returns what the two carry then.
    """
    controller, agent = Controller.load(path), make_policy_agent(str(path))
    qpos, qvel, ahead, _ = lived(300)
    carry, moved = agent.init(Sensed(qpos[:1], qvel[:1])), 0.0
    for k in range(300):
        expected, carry = agent.step(carry, Sensed(qpos[k : k + 1], qvel[k : k + 1]), None)
        targets = controller(qpos[k], qvel[k])
        np.testing.assert_allclose(targets, np.asarray(expected)[0], atol=1e-5)
        moved = max(moved, np.abs(targets - ahead[k, cassie.ACTIVE_QPOS]).max())
    assert moved > 0.1
    assert controller._carry
    return controller._carry, carry


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
