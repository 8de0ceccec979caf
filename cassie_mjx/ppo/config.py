"""Configuration: frozen dataclasses with a sentence and a unit under every field, and the presets that fill them.

A configuration that exists is valid: its constructor checks every value and says in one sentence what is wrong.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

SCHEDULES = ("constant", "linear", "exponential")


def _require(config: object, name: str, valid: bool, expected: str) -> None:
    if not valid:
        raise ValueError(f"{name} is {getattr(config, name)!r}; it must be {expected}.")


@dataclass(frozen=True)
class PPOConfig:
    """Proximal policy optimisation with a fixed-width Gaussian policy; the defaults are the `parallel` preset.

    Sources: *paper* is Xie et al., "Feedback Control For Cassie With Deep Reinforcement Learning" (IROS 2018).

    Raises:
        ValueError: a value is out of its range; the message names the field, the value and the range.
    """

    CHOICES: ClassVar[Mapping[str, Sequence[str]]] = {"actor_schedule": SCHEDULES, "critic_schedule": SCHEDULES}

    num_robots: int = 128
    """Robots that step side by side, over all devices."""

    num_steps: int = 32
    """Control steps that each robot takes in one iteration."""

    iterations: int = 300
    """Iterations (collect, then update) of a whole run; linear schedules and the narrowing of the noise end here."""

    updates_per_iteration: int = 40
    """Minibatch updates in one iteration; 40 updates of 512 samples out of 128 x 32 are 5 epochs."""

    minibatch_size: int = 512
    """Samples in one minibatch, over all devices."""

    hidden_sizes: tuple[int, ...] = (256, 256)
    """Widths of the ReLU layers, the same for actor and critic (*paper*)."""

    privileged_critic: bool = True
    """Whether the critic sees what robots do not sense: how far they are ahead of the reference motion."""

    actor_output_scale: float = 0.01
    """Factor on the He-initialised last layer of the actor: small, so that training starts at the reference motion.

    The paper prints no initialisation; every preset uses this one.
    """

    action_std: float = 0.134
    """Standard deviation of the exploration noise on every action at iteration 0, rad (*paper*: covariance 0.018)."""

    final_action_std: float | None = 0.1
    """What it has become, linearly, by the last iteration, rad; null for what it was.

    Noise slows robots down: a policy that keeps pace with it is too fast without.
    """

    gamma: float = 0.99
    """Discount per control step. The paper prints none; 0.99 looks 100 steps or 3.2 s ahead, about four strides."""

    gae_lambda: float = 0.95
    """Lambda of generalised advantage estimation; 1 gives the Monte-Carlo return with the critic's value at the cut."""

    clip_epsilon: float = 0.2
    """Half-width of the interval around 1 in which the probability ratio still earns surrogate (*paper*)."""

    normalize_advantage: bool = True
    """Whether advantages are brought to mean 0 and standard deviation 1 over the whole batch of an iteration."""

    actor_learning_rate: float = 3e-4
    """Adam step size of the actor at iteration 0."""

    actor_schedule: str = "constant"
    """How the actor's step size and `target_kl` fall over iterations: constant, linear or exponential.

    Constant, for as the noise narrows, the mean moves less for the same divergence.
    """

    critic_learning_rate: float = 1e-3
    """Adam step size of the critic at iteration 0."""

    critic_schedule: str = "linear"
    """How the critic's step size falls over iterations: constant, linear or exponential."""

    learning_rate_decay: float = 0.99
    """Factor an iteration of the exponential schedule (*paper*: 1 % an iteration)."""

    learning_rate_floor: float = 0.1
    """Fraction of the initial step size below which no schedule goes (*paper*: 1e-4 of 1e-3 and 1e-3 of 1e-2)."""

    target_kl: float | None = 0.05
    """KL divergence of one iteration, nats, that the actor's step size is steered to; null steers nothing."""

    max_grad_norm: float | None = 1.0
    """Euclidean norm to which the actor's gradient is cut back; null never cuts it."""

    adam_epsilon: float = 1e-5
    """Adam's epsilon, for actor and critic."""

    normalizer_samples: int = 50_000
    """States of a random policy from which mean and standard deviation of the inputs are estimated (*paper*)."""

    def __post_init__(self) -> None:
        """Check every field; a list of hidden sizes, as a command line gives it, becomes a tuple."""
        object.__setattr__(self, "hidden_sizes", tuple(self.hidden_sizes))
        for name in (
            "num_robots",
            "num_steps",
            "iterations",
            "updates_per_iteration",
            "minibatch_size",
            "normalizer_samples",
        ):
            _require(self, name, getattr(self, name) >= 1, "at least 1")
        for name in (
            "action_std",
            "clip_epsilon",
            "actor_learning_rate",
            "critic_learning_rate",
            "adam_epsilon",
        ):
            _require(self, name, getattr(self, name) > 0, "greater than 0")
        for name in ("target_kl", "max_grad_norm"):
            value = getattr(self, name)
            _require(self, name, value is None or value > 0, "greater than 0, or null to switch it off")
        last = self.final_action_std
        narrows = last is None or 0 < last <= self.action_std
        _require(
            self, "final_action_std", narrows, f"greater than 0 and at most action_std, {self.action_std}, or null"
        )
        for name in ("gamma", "gae_lambda", "learning_rate_floor"):
            _require(self, name, 0 <= getattr(self, name) <= 1, "from 0 to 1")
        for name in ("actor_output_scale", "learning_rate_decay"):
            _require(self, name, 0 < getattr(self, name) <= 1, "greater than 0 and at most 1")
        for name in ("actor_schedule", "critic_schedule"):
            _require(self, name, getattr(self, name) in SCHEDULES, f"one of {', '.join(SCHEDULES)}")
        valid_sizes = len(self.hidden_sizes) >= 1 and all(size >= 1 for size in self.hidden_sizes)
        _require(self, "hidden_sizes", valid_sizes, "one or more positive widths")
        fits = self.minibatch_size <= self.num_samples
        _require(self, "minibatch_size", fits, f"at most num_robots x num_steps = {self.num_samples}")

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
        target_kl=None,
        max_grad_norm=None,
        adam_epsilon=1e-8,
    ),
    # Two CPU cores: enough robots to fill the threads, so few steps that the policy that collects is never old.
    "parallel": PPOConfig(),
    # One accelerator: 16 times the batch and the minibatch of `parallel`, hence as many updates an iteration.
    "massive": PPOConfig(num_robots=4096, num_steps=16, iterations=300, minibatch_size=8192),
}
"""The learner's presets by name."""
