"""What the learner passes around: pytrees with a shape on every field.

Axes: T control steps, B robots, O observation, P privileged state, A action, N what a recurrent actor carries (0 of any
other). Arrays are float32 where nothing else is said.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

import optax
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

Params = Mapping[str, Mapping[str, Array]]
"""Parameters of one network: layer name to `kernel` [inputs, outputs] and `bias` [outputs]; `gru` to those of a
`control.network.Gru`."""


@runtime_checkable
class EnvState(Protocol):
    """What the learner reads of an environment's state, which is otherwise a pytree of the environment's own.

    One state describes B robots. After a step, a robot whose episode ended has already been reset: `observation` is
    then the first of the new episode, and `final_observation` the last of the old. For every other robot the two are
    equal. So it is with `privileged` and `final_privileged`.
    """

    observation: Any
    """[B, O] what the policy acts on next."""
    final_observation: Any
    """[B, O] what the last step led to, before any reset."""
    privileged: Any
    """[B, P] what only a critic sees, scaled to the order of 1; P may be 0."""
    final_privileged: Any
    """[B, P] the same after the last step, before any reset."""
    reward: Any
    """[B] reward of the last step."""
    terminated: Any
    """[B] bool: the episode ended in failure, and nothing is earned after it."""
    truncated: Any
    """[B] bool: the episode was cut short by a time limit, and would have earned more."""
    metrics: Any
    """Pytree of [B]: whatever else is worth recording of the last step; the learner only hands it on."""


Step = Callable[[Any, Any, Key[Array, ""]], Any]
"""`step(env_state, action [B, A], key) -> env_state`: one control step, with a reset where an episode ends."""


class Robots(NamedTuple):
    """B robots between two control steps."""

    env: Any
    """Their environment's state (`EnvState`)."""
    hidden: Float[Array, "B N"]
    """What the policy carries of them: 0 where an episode begins."""


class Normalizer(NamedTuple):
    """Running statistics of the observations, in Welford's form."""

    samples: Float[Array, ""]
    """Observations seen so far."""
    mean: Float[Array, " O"]
    """Their mean."""
    squares: Float[Array, " O"]
    """Sum of their squared deviations from the mean."""


class Policy(NamedTuple):
    """All that acting needs."""

    normalizer: Normalizer
    actor: Params
    std: Float[Array, ""]
    """Standard deviation of the exploration noise on every action, rad."""


class LearnerState(NamedTuple):
    """Everything the learner carries from one iteration to the next."""

    policy: Policy
    critic: Params
    actor_optimizer: optax.OptState
    critic_optimizer: optax.OptState
    step_factor: Float[Array, ""]
    """Factor on the actor's scheduled step size, adapted to the KL divergence."""
    iteration: Int[Array, ""]
    """Updates done so far."""


class Rollout(NamedTuple):
    """T control steps of B robots, episode after episode, as they were lived."""

    observation: Float[Array, "T B O"]
    """What the policy acted on."""
    action: Float[Array, "T B A"]
    """What it did."""
    log_prob: Float[Array, "T B"]
    """Log density of that action under the policy that took it."""
    reward: Float[Array, "T B"]
    terminated: Bool[Array, "T B"]
    """The step ended the episode in failure: the value of what follows is 0."""
    truncated: Bool[Array, "T B"]
    """The step met a time limit: the value of what follows is the critic's at `final_observation`."""
    final_observation: Float[Array, "T B O"]
    """What the step led to, before any reset."""
    privileged: Float[Array, "T B P"]
    """What the critic saw besides `observation`."""
    final_privileged: Float[Array, "T B P"]
    """What it saw besides `final_observation`."""
    hidden: Float[Array, "T B N"]
    """What the policy carried when it acted."""
    metrics: PyTree[Array]
    """What the environment recorded, each leaf [T, B, ...]."""


class UpdateMetrics(NamedTuple):
    """Scalars that describe one update."""

    reward: Float[Array, ""]
    """Mean reward of a control step."""
    terminated: Float[Array, ""]
    """Fraction of the control steps that ended an episode in failure."""
    truncated: Float[Array, ""]
    """Fraction of the control steps that met a time limit."""
    actor_loss: Float[Array, ""]
    """Clipped surrogate loss, mean over the minibatches."""
    critic_loss: Float[Array, ""]
    """Half the squared error of the critic, mean over the minibatches."""
    kl: Float[Array, ""]
    """KL divergence of the new policy from the one that collected, nats, over the whole batch."""
    clip_fraction: Float[Array, ""]
    """Fraction of the samples whose probability ratio ended outside the clip interval, over the whole batch."""
    explained_variance: Float[Array, ""]
    """1 - Var[target - value] / Var[target] of the critic that the update began with; 1 is perfect, 0 a constant."""
    action_std: Float[Array, ""]
    """Standard deviation of the exploration noise that collected the rollout, rad."""
    actor_learning_rate: Float[Array, ""]
    critic_learning_rate: Float[Array, ""]
