"""What a run says of itself, where that is more than a few words."""

from pathlib import Path

import jax
import numpy as np

from cassie_mjx.training.config import TrainConfig
from cassie_mjx.training.counters import Counters
from cassie_mjx.training.memory import needed_bytes, present_bytes

CLIPPED_SHARE = 0.01
"""Share of the samples in which an input of the networks may be clipped without a word."""


def plan(config: TrainConfig) -> str:
    """What a resolved configuration trains."""
    origin = f" from the policy {config.init}" if config.init else ""
    mjx = config.physics == "mjx"
    count = jax.device_count() if mjx else jax.process_count()
    spread = f" {'on' if mjx else 'in'} {count} {'devices' if mjx else 'processes'}" if count > 1 else ""
    told = config.speed if config.command == "speed" else config.command
    return (
        f"{told} on {config.reference}{origin}, {config.ppo.num_robots} robots on {config.physics}{spread} "
        f"at {config.physics_hz} Hz, {config.ppo.iterations} iterations of {config.ppo.num_samples:,} samples."
        f"{_memory(config) if config.physics == 'mjx' else ''}"
    )


def _memory(config: TrainConfig) -> str:
    needed = needed_bytes(config.ppo, config.walk, "mjx", config.physics_hz or 0)
    return f" They take about {needed / 1e9:.1f} of {present_bytes('mjx') / 1e9:,.0f} GB of memory."


def conclusion(best: Path, counters: Counters) -> str:
    """What came of a run, and what to do next."""
    return (
        f"Done: a return of {counters.return_plain:.1f} of 300 by the plain reward, "
        f"{counters.return_weighted:.1f} by the weighted one, after {counters.train_s:.0f} s of training.\n"
        f"The policy: {best}\n"
        f"Next: python -m cassie_mjx.evaluate policy={best}"
    )


def not_finite(config: TrainConfig, iteration: int, saved: int | None) -> str:
    """Why a learner with numbers that are not finite stops, what is left of the run, and what to try."""
    ppo = config.ppo
    rates = [f"ppo.{name} below {getattr(ppo, name):g}" for name in ("actor_learning_rate", "critic_learning_rate")]
    bound = [] if ppo.max_grad_norm else ["ppo.max_grad_norm=1"]
    return (
        f"The learner's numbers stopped being finite in iteration {iteration}, of which nothing is kept; the "
        f"checkpoint of iteration {saved} and the policies in {config.run_dir} are as they were. Train in another "
        f"run_dir with smaller steps: {', '.join([*rates, *bound])}."
    )


def best_lost(best: Path, lost: Counters, now: Counters) -> str:
    """What has taken the place of a best policy that is not there any more."""
    return (
        f"{best} was missing or damaged: the best policy, with a return of {lost.return_plain:.1f} by the plain reward "
        f"and {lost.return_weighted:.1f} by the weighted one, is lost. That of the last checkpoint has taken its "
        f"place, with {now.return_plain:.1f} and {now.return_weighted:.1f}."
    )


def clipping(shares: np.ndarray, description: list[str]) -> str:
    """Of inputs the networks do not see all of; "" if there are none.

    Args:
      shares: of the samples in which each input was clipped, [O].
      description: of the observation, a line for one or more inputs.
    """
    over, worst = int((shares > CLIPPED_SHARE).sum()), int(shares.argmax())
    if not over:
        return ""
    (line,) = [line for line in description if worst in _inputs(line)]
    return (
        f"{over} of the policy's {len(shares)} inputs are clipped in more than {CLIPPED_SHARE:.0%} of the samples; "
        f"most often input {worst}, in {shares[worst]:.1%} ({line}). Train from scratch, or from a policy whose inputs "
        "have about the same range."
    )


def _inputs(line: str) -> range:
    """The inputs that a line of an observation's description is about, such as "0:2"."""
    start, stop = line.split()[0].split(":")
    return range(int(start), int(stop))
