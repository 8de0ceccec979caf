"""Proximal policy optimisation (Schulman et al. 2017) as two pure functions: `init` and `update`."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, Key

from cassie_mjx.ppo import loss, networks, normalizer
from cassie_mjx.ppo.advantage import average, generalized_advantage, standardize
from cassie_mjx.ppo.config import PPOConfig
from cassie_mjx.ppo.types import LearnerState, Params, Policy, Rollout, UpdateMetrics

# The step size is left alone while the KL divergence is within KL_BAND times its target, either way, and changes by
# KL_STEP otherwise: a small step, because the divergence of one iteration is noisy.
KL_BAND = 1.5
KL_STEP = 1.3
# The bounds only stop a run-away, such as when all rewards are equal.
STEP_FACTOR_BOUNDS = (0.01, 10.0)


class LearningRates(NamedTuple):
    """Adam's step sizes in one iteration."""

    actor: Float[Array, ""]
    critic: Float[Array, ""]


class _Losses(NamedTuple):
    actor: Float[Array, ""]
    critic: Float[Array, ""]


class _Batch(NamedTuple):
    """Axis S are samples, in any order; of a recurrent actor two axes, robots and their control steps."""

    inputs: Float[Array, "*S O"]
    critic_inputs: Float[Array, "*S C"]
    action: Float[Array, "*S A"]
    log_prob: Float[Array, "*S"]
    advantage: Float[Array, "*S"]
    value_target: Float[Array, "*S"]
    hidden: Float[Array, "*S N"]
    ended: Bool[Array, "*S"]


def init(
    key: Key[Array, ""], config: PPOConfig, observation_size: int, action_size: int, privileged_size: int
) -> LearnerState:
    """Draw an untrained learner, whose normaliser has seen nothing yet.

    With `config.privileged_critic` the critic has `privileged_size` inputs besides the observation.

    Raises:
        ValueError: a size is not positive.
    """
    if observation_size < 1 or action_size < 1:
        raise ValueError(f"Sizes must be at least 1, not {observation_size} (observation) and {action_size} (action).")
    actor_key, critic_key = jax.random.split(key)
    draw = networks.init_recurrent if config.network == "gru" else networks.init
    actor = draw(actor_key, observation_size, config.hidden_sizes, action_size, config.actor_output_scale)
    critic_size = observation_size + config.privileged_critic * privileged_size
    critic = networks.init(critic_key, critic_size, config.hidden_sizes, 1)
    return LearnerState(
        policy=Policy(normalizer.init(observation_size), actor, jnp.float32(config.action_std)),
        critic=critic,
        actor_optimizer=_actor_optimizer(config).init(actor),
        critic_optimizer=_critic_optimizer(config).init(critic),
        step_factor=jnp.ones(()),
        iteration=jnp.zeros((), jnp.int32),
    )


@partial(jax.jit, static_argnames=("config", "axis_name"))
def update(
    config: PPOConfig, state: LearnerState, rollout: Rollout, key: Key[Array, ""], axis_name: str | None = None
) -> tuple[LearnerState, UpdateMetrics]:
    """Learn from one rollout: `config.updates_per_iteration` minibatch updates of actor and critic.

    On several devices, call it inside `jax.shard_map(..., check_vma=False)` with the rollout split along its robots
    and with state and key the same everywhere; gradients, advantage statistics and metrics are then averaged over
    `axis_name`, and every device returns the same state.

    Args:
        config: how to learn; sizes count over all devices.
        state: the learner so far. The policy in it must be the one that collected the rollout.
        rollout: `config.num_steps` x `config.num_robots` samples, or this device's robots of them.
        key: shuffles the minibatches; used up here.
        axis_name: mapped device axis over which the robots are spread, if any.

    Returns:
        The new state and what to log.

    Raises:
        ValueError: the rollout is not of the size that `config` says, or does not divide among the devices.
    """
    devices = 1 if axis_name is None else jax.lax.axis_size(axis_name)
    check_devices(config, devices)
    _check_rollout(config, rollout, devices)
    batch, explained_variance = _prepare(config, state, rollout, axis_name)
    rates = learning_rates(config, state)

    def train_on(state: LearnerState, rows: Int[Array, " M"]) -> tuple[LearnerState, _Losses]:
        return _train(config, state, jax.tree.map(lambda x: x[rows], batch), rates, axis_name)

    size = config.minibatch_size // (config.sequence_steps * devices)
    rows = _shuffled_rows(key, batch.log_prob.shape[0], config.updates_per_iteration, size)
    trained, losses = jax.lax.scan(train_on, state, rows)
    local = _rollout_metrics(rollout) | _fit_metrics(config, trained.policy, batch, losses)
    metrics = UpdateMetrics(
        **average(local, axis_name),
        explained_variance=explained_variance,
        action_std=state.policy.std,
        actor_learning_rate=rates.actor,
        critic_learning_rate=rates.critic,
    )
    iteration = state.iteration + 1
    policy = trained.policy._replace(std=action_std(config, iteration))
    return trained._replace(policy=policy, step_factor=_adapt(config, state, metrics.kl), iteration=iteration), metrics


def check_devices(config: PPOConfig, devices: int) -> None:
    """Raise ValueError unless robots and minibatches divide among the devices."""
    for name in ("num_robots", "minibatch_size"):
        if getattr(config, name) % devices:
            raise ValueError(f"{name} is {getattr(config, name)}; it must be a multiple of the {devices} devices.")
    if config.minibatch_size % (devices * config.sequence_steps):
        raise ValueError(
            f"minibatch_size is {config.minibatch_size}; for network=gru it must be a multiple of num_steps="
            f"{config.num_steps} on each of the {devices} devices."
        )


def learning_rates(config: PPOConfig, state: LearnerState) -> LearningRates:
    """Return the step sizes of the coming update."""
    actor_rate = config.actor_learning_rate * _schedule(config, config.actor_schedule, state.iteration)
    critic_rate = config.critic_learning_rate * _schedule(config, config.critic_schedule, state.iteration)
    return LearningRates(actor_rate * state.step_factor, critic_rate)


def action_std(config: PPOConfig, iteration: Int[Array, ""]) -> Float[Array, ""]:
    """Return the standard deviation of the exploration noise in an iteration."""
    last = config.action_std if config.final_action_std is None else config.final_action_std
    done = jnp.minimum(iteration / config.iterations, 1.0)
    return (1 - done) * config.action_std + done * last


def _schedule(config: PPOConfig, name: str, iteration: Int[Array, ""]) -> Float[Array, ""]:
    done = iteration.astype(jnp.float32)
    if name == "linear":
        factor = 1.0 - done / config.iterations
    elif name == "cosine":
        fallen = jnp.maximum(0.0, 1.5 * done / config.iterations - 0.5)
        factor = 0.5 * (1.0 + jnp.cos(jnp.pi * fallen))
    elif name == "exponential":
        factor = config.learning_rate_decay**done
    else:
        factor = jnp.ones(())
    return jnp.maximum(factor, config.learning_rate_floor)


def _adapt(config: PPOConfig, state: LearnerState, kl: Float[Array, ""]) -> Float[Array, ""]:
    if config.target_kl is None:
        return state.step_factor
    # The scheduled step size alone would not fall, for the factor would rise to keep the divergence; so both fall.
    target = config.target_kl * _schedule(config, config.actor_schedule, state.iteration)
    too_far, too_short = kl > target * KL_BAND, kl < target / KL_BAND
    change = jnp.where(too_far, 1 / KL_STEP, jnp.where(too_short, KL_STEP, 1.0))
    return jnp.clip(state.step_factor * change, *STEP_FACTOR_BOUNDS)


def _prepare(
    config: PPOConfig, state: LearnerState, rollout: Rollout, axis_name: str | None
) -> tuple[_Batch, Float[Array, ""]]:
    inputs = normalizer.normalize(state.policy.normalizer, rollout.observation)
    final_inputs = normalizer.normalize(state.policy.normalizer, rollout.final_observation)
    critic_inputs = _critic_inputs(config, inputs, rollout.privileged)
    value = networks.critic_value(state.critic, critic_inputs)
    next_value = networks.critic_value(state.critic, _critic_inputs(config, final_inputs, rollout.final_privileged))
    advantage, value_target = generalized_advantage(
        rollout.reward, value, next_value, rollout.terminated, rollout.truncated, config.gamma, config.gae_lambda
    )
    explained_variance = loss.explained_variance(value, value_target, axis_name)
    if config.normalize_advantage:
        advantage = standardize(advantage, axis_name)
    ended = rollout.terminated | rollout.truncated
    lived = rollout.action, rollout.log_prob, advantage, value_target, rollout.hidden, ended
    return _rows(config, _Batch(inputs, critic_inputs, *lived)), explained_variance


def _rows(config: PPOConfig, batch: _Batch) -> _Batch:
    """What minibatches are drawn from, first axis: samples, or robots with all their control steps."""
    if config.network == "gru":
        return jax.tree.map(lambda x: x.swapaxes(0, 1), batch)
    return jax.tree.map(lambda x: x.reshape(x.shape[0] * x.shape[1], *x.shape[2:]), batch)


def _rollout_metrics(rollout: Rollout) -> dict[str, Float[Array, ""]]:
    ended = {name: getattr(rollout, name).mean(dtype=jnp.float32) for name in ("terminated", "truncated")}
    return {"reward": rollout.reward.mean(), **ended}


def _fit_metrics(config: PPOConfig, policy: Policy, batch: _Batch, losses: _Losses) -> dict[str, Float[Array, ""]]:
    """How well the updates went, and how far they took the policy from the one that collected the batch."""
    log_prob = _log_prob(policy, batch)
    return {
        "actor_loss": losses.actor.mean(),
        "critic_loss": losses.critic.mean(),
        "kl": loss.kl_estimate(log_prob, batch.log_prob),
        "clip_fraction": loss.clip_fraction(log_prob, batch.log_prob, config.clip_epsilon),
    }


def _critic_inputs(
    config: PPOConfig, inputs: Float[Array, "T B O"], privileged: Float[Array, "T B P"]
) -> Float[Array, "T B C"]:
    return jnp.concatenate([inputs, privileged], axis=-1) if config.privileged_critic else inputs


def _shuffled_rows(key: Key[Array, ""], samples: int, updates: int, size: int) -> Int[Array, "updates size"]:
    # One shuffled pass after another, cut into minibatches: every sample is used equally often, to within one.
    passes = -(-updates * size // samples)
    order = jax.vmap(lambda pass_key: jax.random.permutation(pass_key, samples))(jax.random.split(key, passes))
    return order.reshape(-1)[: updates * size].reshape(updates, size)


def _train(
    config: PPOConfig, state: LearnerState, minibatch: _Batch, rates: LearningRates, axis_name: str | None
) -> tuple[LearnerState, _Losses]:
    actor_loss, actor_gradient = jax.value_and_grad(_actor_loss)(state.policy.actor, state.policy, minibatch, config)
    critic_loss, critic_gradient = jax.value_and_grad(_critic_loss)(state.critic, minibatch)
    actor_gradient, critic_gradient = average((actor_gradient, critic_gradient), axis_name)

    actor_step, actor_optimizer = _actor_optimizer(config).update(actor_gradient, state.actor_optimizer)
    critic_step, critic_optimizer = _critic_optimizer(config).update(critic_gradient, state.critic_optimizer)
    trained = state._replace(
        policy=state.policy._replace(actor=_descend(state.policy.actor, actor_step, rates.actor)),
        critic=_descend(state.critic, critic_step, rates.critic),
        actor_optimizer=actor_optimizer,
        critic_optimizer=critic_optimizer,
    )
    return trained, _Losses(actor_loss, critic_loss)


def _log_prob(policy: Policy, batch: _Batch) -> Float[Array, "*S"]:
    mean = networks.actor_mean(policy.actor, batch.inputs, batch.hidden, batch.ended)
    return networks.log_prob(mean, policy.std, batch.action)


def _actor_loss(actor: Params, policy: Policy, batch: _Batch, config: PPOConfig) -> Float[Array, ""]:
    log_prob = _log_prob(policy._replace(actor=actor), batch)
    return loss.clipped_surrogate(log_prob, batch.log_prob, batch.advantage, config.clip_epsilon)


def _critic_loss(critic: Params, batch: _Batch) -> Float[Array, ""]:
    return loss.squared_error(networks.critic_value(critic, batch.critic_inputs), batch.value_target)


def _actor_optimizer(config: PPOConfig) -> optax.GradientTransformation:
    bound = optax.identity() if config.max_grad_norm is None else optax.clip_by_global_norm(config.max_grad_norm)
    return optax.chain(bound, optax.scale_by_adam(eps=config.adam_epsilon))


def _critic_optimizer(config: PPOConfig) -> optax.GradientTransformation:
    return optax.scale_by_adam(eps=config.adam_epsilon)


def _descend(params: Params, step: optax.Updates, learning_rate: Float[Array, ""]) -> Params:
    return jax.tree.map(lambda p, s: p - learning_rate * s, params, step)


def _check_rollout(config: PPOConfig, rollout: Rollout, devices: int) -> None:
    given, expected = tuple(rollout.reward.shape), (config.num_steps, config.num_robots // devices)
    if given != expected:
        raise ValueError(
            f"The rollout is {given} steps x robots; num_steps and num_robots call for {expected} a device."
        )
