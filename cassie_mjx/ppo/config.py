"""Configuration: frozen dataclasses with a sentence and a unit under every field, and the presets that fill them.

A configuration that exists is valid: its constructor checks every value and says in one sentence what is wrong.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar

from cassie_mjx.configuration.values import Checked, Range, shown

NETWORKS = ("mlp", "gru")
SCHEDULES = ("constant", "linear", "cosine", "exponential")


MOST_LAYERS = 64
"""Hidden layers of a network."""


@dataclass(frozen=True)
class PPOConfig(Checked):
    """Proximal policy optimisation with a fixed-width Gaussian policy; the defaults are the `parallel` preset.

    Sources: *paper* is Xie et al., "Feedback Control For Cassie With Deep Reinforcement Learning" (IROS 2018).

    Raises:
        ValueError: a value is out of its range; the message names the field, the value and the range.
    """

    CHOICES: ClassVar[Mapping[str, Sequence[str]]] = {
        "network": NETWORKS,
        "actor_schedule": SCHEDULES,
        "critic_schedule": SCHEDULES,
    }

    num_robots: Annotated[int, Range(1, 1_000_000)] = 128
    """Robots that step side by side, over all devices."""

    num_steps: Annotated[int, Range(1, 100_000)] = 8
    """Control steps that each robot takes in one iteration: few, so that the policy improves often."""

    iterations: Annotated[int, Range(1, 10_000_000)] = 1200
    """Iterations (collect, then update) of a whole run; linear schedules and the narrowing of the noise end here."""

    updates_per_iteration: Annotated[int, Range(1, 1_000_000)] = 10
    """Minibatch updates in one iteration; 10 updates of 512 samples out of 128 x 8 are 5 epochs."""

    minibatch_size: Annotated[int, Range(1, 1_000_000_000)] = 512
    """Samples in one minibatch, over all devices."""

    network: str = "mlp"
    """What the actor is: "mlp", ReLU layers; "gru", which remembers: a gated recurrent unit in place of the first of
    them, trained through the `num_steps` of each robot. The critic is "mlp" either way."""

    hidden_sizes: tuple[Annotated[int, Range(1, 65_536)], ...] = (256, 256)
    """Widths of the ReLU layers, the same for actor and critic (*paper*); the first is that of a GRU too."""

    privileged_critic: bool = True
    """Whether the critic sees what robots do not sense: how far they are ahead of the reference motion."""

    actor_output_scale: Annotated[float, Range(1e-6, 1)] = 0.01
    """Factor on the He-initialised last layer of the actor: small, so that training starts at the reference motion.

    The paper prints no initialisation; every preset uses this one.
    """

    action_std: Annotated[float, Range(1e-4, 10)] = 0.134
    """Standard deviation of the exploration noise on every action at iteration 0, rad (*paper*: covariance 0.018)."""

    final_action_std: Annotated[float, Range(1e-4, 10)] | None = 0.05
    """What it has become, linearly, by the last iteration, rad; null for what it was.

    Noise slows robots down: policies trained with noise walk too fast without it.
    """

    gamma: Annotated[float, Range(0, 1)] = 0.99
    """Discount per control step. The paper prints none; 0.99 looks 100 steps or 3.2 s ahead, about four strides."""

    gae_lambda: Annotated[float, Range(0, 1)] = 0.95
    """Lambda of generalised advantage estimation; 1 gives the Monte-Carlo return with the critic's value at the cut."""

    clip_epsilon: Annotated[float, Range(1e-4, 100)] = 0.2
    """Half-width of the interval around 1 in which the probability ratio still earns surrogate (*paper*)."""

    normalize_advantage: bool = True
    """Whether advantages are brought to mean 0 and standard deviation 1 over the whole batch of an iteration."""

    actor_learning_rate: Annotated[float, Range(1e-9, 1)] = 3e-4
    """Adam step size of the actor at iteration 0."""

    actor_schedule: str = "cosine"
    """How the actor's step size and `target_kl` fall: not at all (constant), linearly over the run (linear), along
    half a cosine after its first third (cosine), or exponentially (exponential).

    Fast speeds take a third of a run to walk at all; large steps in the end would let the speed sway.
    """

    critic_learning_rate: Annotated[float, Range(1e-9, 1)] = 1e-3
    """Adam step size of the critic at iteration 0."""

    critic_schedule: str = "linear"
    """How the critic's step size falls over iterations: constant, linear, cosine or exponential."""

    learning_rate_decay: Annotated[float, Range(0.01, 1)] = 0.99
    """Factor an iteration of the exponential schedule (*paper*: 1 % an iteration)."""

    learning_rate_floor: Annotated[float, Range(0, 1)] = 0.03
    """Fraction of the initial step size below which no schedule goes (*paper*: 1e-4 of 1e-3 and 1e-3 of 1e-2)."""

    target_kl: Annotated[float, Range(1e-6, 100)] | None = 0.05
    """KL divergence of one iteration, nats, that the actor's step size is steered to; null steers nothing."""

    max_grad_norm: Annotated[float, Range(1e-6, 1_000_000)] | None = 1.0
    """Euclidean norm to which the actor's gradient is cut back; null never cuts it."""

    adam_epsilon: Annotated[float, Range(1e-12, 1)] = 1e-5
    """Adam's epsilon, for actor and critic."""

    normalizer_samples: Annotated[int, Range(1, 100_000_000)] = 50_000
    """States of a random policy from which mean and standard deviation of the inputs are estimated (*paper*)."""

    def __post_init__(self) -> None:
        """Check every field; a list of hidden sizes, as a program may give it, becomes a tuple."""
        object.__setattr__(self, "hidden_sizes", tuple(self.hidden_sizes))
        super().__post_init__()
        if not 1 <= len(self.hidden_sizes) <= MOST_LAYERS:
            raise ValueError(f"hidden_sizes={shown(self.hidden_sizes)} must be 1 to {MOST_LAYERS} widths.")
        if self.final_action_std is not None and self.final_action_std > self.action_std:
            raise ValueError(
                f"final_action_std={self.final_action_std} must be at most action_std={self.action_std}, or null."
            )
        if self.minibatch_size > self.num_samples:
            raise ValueError(
                f"minibatch_size={self.minibatch_size} must be at most num_robots x num_steps = {self.num_samples}."
            )

        if self.minibatch_size % self.sequence_steps:
            raise ValueError(
                f"minibatch_size={self.minibatch_size} must be a multiple of num_steps={self.num_steps} with "
                "network=gru, which learns from whole sequences."
            )

    @property
    def sequence_steps(self) -> int:
        """Control steps of one robot that stay together in a minibatch."""
        return self.num_steps if self.network == "gru" else 1

    @property
    def num_samples(self) -> int:
        """Samples of one iteration, over all robots and devices."""
        return self.num_robots * self.num_steps


PPO_PRESETS = {
    # The paper's figures: at most 3,000 samples, 64 updates of 128, Adam 1e-3 and 1e-2 falling 1 % an iteration. It
    # names no advantage normalisation, gradient clipping or KL rule, so these are off; Adam's epsilon is Adam's own.
    "paper": PPOConfig(
        num_robots=10,
        num_steps=300,
        iterations=300,
        updates_per_iteration=64,
        minibatch_size=128,
        privileged_critic=False,
        final_action_std=None,
        gae_lambda=1.0,
        normalize_advantage=False,
        actor_learning_rate=1e-3,
        actor_schedule="exponential",
        critic_learning_rate=1e-2,
        critic_schedule="exponential",
        learning_rate_floor=0.1,
        target_kl=None,
        max_grad_norm=None,
        adam_epsilon=1e-8,
    ),
    # Two CPU cores: enough robots to fill the threads, so few steps that the policy that collects is never old.
    "parallel": PPOConfig(),
    # One accelerator: 64 times the batch of `parallel`, so a policy that need not improve so often.
    "massive": PPOConfig(
        num_robots=4096,
        num_steps=16,
        iterations=300,
        updates_per_iteration=40,
        minibatch_size=8192,
        final_action_std=0.1,
        actor_schedule="constant",
        learning_rate_floor=0.1,
    ),
}
"""The learner's presets by name."""
