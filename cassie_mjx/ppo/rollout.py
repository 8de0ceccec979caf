"""Collecting experience: one loop for an environment that can be compiled, one for an environment on the host.

Both use their keys alike, so a deterministic environment written twice gives the same rollout through either.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from cassie_mjx.control.network import forgotten, start
from cassie_mjx.ppo import networks
from cassie_mjx.ppo import normalizer as normalization
from cassie_mjx.ppo.config import PPOConfig
from cassie_mjx.ppo.types import EnvState, Normalizer, Policy, Robots, Rollout, Step

Collect = Callable[[Policy, Robots, Key[Array, ""]], tuple[Robots, Rollout]]
"""`collect(policy, robots, key) -> robots, rollout`: either function below with `step` and `config` bound."""


def begin(policy: Policy, env_state: Any) -> Robots:
    """Robots at the start of episodes, of which the policy remembers nothing."""
    return Robots(env_state, start(networks.acting(policy), len(env_state.observation)))


@partial(jax.jit, static_argnames=("step", "config"))
def collect(
    step: Step, config: PPOConfig, policy: Policy, robots: Robots, key: Key[Array, ""]
) -> tuple[Robots, Rollout]:
    """Take `config.num_steps` control steps in one compiled loop.

    Args:
        step: the environment; compiled, so it must be a pure JAX function, and the same object on every call.
        config: gives the number of steps.
        policy: what chooses the actions.
        robots: where they are.
        key: used up here.

    Returns:
        The robots as they are left, from where the next rollout goes on, and the rollout.
    """

    def one_step(before: Robots, step_key: Key[Array, ""]) -> tuple[Robots, Rollout]:
        action, log_prob, hidden, env_key = _act(policy, before.env.observation, before.hidden, step_key)
        after = step(before.env, action, env_key)
        return _left(after, hidden), _record(before, action, log_prob, after)

    _check_width(policy, robots.env)
    return jax.lax.scan(one_step, robots, jax.random.split(key, config.num_steps))


def collect_on_host(
    step: Step, config: PPOConfig, policy: Policy, robots: Robots, key: Key[Array, ""]
) -> tuple[Robots, Rollout]:
    """Take `config.num_steps` control steps in a Python loop, for an environment that steps NumPy arrays.

    Only the policy is compiled. Arguments and results are those of `collect`, with NumPy arrays for JAX arrays; `step`
    must return new arrays rather than write into those of the state it was given.
    """
    _check_width(policy, robots.env)
    rows = []
    for step_key in jax.random.split(key, config.num_steps):
        action, log_prob, hidden, env_key = _act_compiled(policy, robots.env.observation, robots.hidden, step_key)
        action = np.asarray(action)
        after = step(robots.env, action, env_key)
        rows.append(_record(robots, action, log_prob, after))
        robots = _left(after, np.asarray(hidden))
    return robots, jax.tree.map(lambda *leaves: np.stack(leaves), *rows)


def random_policy_statistics(
    collect: Collect, policy: Policy, robots: Robots, key: Key[Array, ""], samples: int
) -> Normalizer:
    """Estimate the observations' mean and standard deviation from states that a random policy visits.

    The random policy is exploration noise around zero: an actor whose weights are all 0.

    Args:
        collect: `collect` or `collect_on_host` with `step` and `config` bound by `functools.partial`.
        policy: any policy of the right shapes; its numbers play no part.
        robots: freshly reset.
        key: used up here.
        samples: observations wanted; the last rollout is used to its end, so a few more are taken.
    """
    random_policy = policy._replace(actor=jax.tree.map(jnp.zeros_like, policy.actor))
    return policy_statistics(collect, random_policy, robots, key, samples)


def policy_statistics(
    collect: Collect, policy: Policy, robots: Robots, key: Key[Array, ""], samples: int
) -> Normalizer:
    """Estimate the observations' mean and standard deviation from states that a policy visits, noise included.

    Arguments as those of `random_policy_statistics`.
    """
    normalizer = normalization.init(policy.normalizer.mean.shape[0])
    rollouts = 0
    while normalizer.samples < samples:
        robots, rollout = collect(policy, robots, jax.random.fold_in(key, rollouts))
        normalizer = _update_normalizer(normalizer, rollout.observation)
        rollouts += 1
    return normalizer


def _act(
    policy: Policy, observation: Float[Array, "B O"], hidden: Float[Array, "B N"], key: Key[Array, ""]
) -> tuple[Float[Array, "B A"], Float[Array, " B"], Float[Array, "B N"], Key[Array, ""]]:
    action_key, env_key = jax.random.split(key)
    action, log_prob, hidden = networks.sample(policy, observation, hidden, action_key)
    return action, log_prob, hidden, env_key


_act_compiled = jax.jit(_act)
_update_normalizer = jax.jit(normalization.update)


def _left(after: EnvState, hidden: Any) -> Robots:
    """Robots after a step; of those whose episode ended nothing is carried on."""
    return Robots(after, forgotten(hidden, after.terminated | after.truncated))


def _record(before: Robots, action: Any, log_prob: Any, after: EnvState) -> Rollout:
    return Rollout(
        observation=before.env.observation,
        action=action,
        log_prob=log_prob,
        reward=after.reward,
        terminated=after.terminated,
        truncated=after.truncated,
        final_observation=after.final_observation,
        privileged=before.env.privileged,
        final_privileged=after.final_privileged,
        hidden=before.hidden,
        metrics=after.metrics,
    )


def _check_width(policy: Policy, env_state: EnvState) -> None:
    given, expected = env_state.observation.shape[-1], policy.normalizer.mean.shape[0]
    if given != expected:
        raise ValueError(f"The environment observes {given} numbers a robot; this policy was made for {expected}.")
