"""After which iterations a run saves a checkpoint, and after which of these it measures the return."""

from cassie_mjx.evaluation.returns import EPISODE_STEPS
from cassie_mjx.training.config import TrainConfig

CHECKPOINTS = 30
"""Checkpoints of a run, about, where `evaluate_every` is null."""

SKIPPED = 10
"""Checkpoints from one measurement to the next, of policies that walk, where `evaluate_every` is null.

One that walks costs 192,000 physics steps, ten times as many as one that falls at once."""


def saves(config: TrainConfig, iteration: int) -> bool:
    """Whether a checkpoint is saved, and a line of metrics written, after this iteration."""
    return iteration % period(config) == 0 or iteration == config.ppo.iterations


def measures(config: TrainConfig, iteration: int, walked: float) -> bool:
    """Whether the return is measured after an iteration that `saves`.

    Args:
      config: of the run.
      iteration: which one.
      walked: control steps that the last policy measured has walked, mean over the starts, of `EPISODE_STEPS`.
    """
    if config.evaluate_every or walked < EPISODE_STEPS or iteration == config.ppo.iterations:
        return True
    return iteration % (SKIPPED * period(config)) == 0


def period(config: TrainConfig) -> int:
    """Iterations between checkpoints."""
    return config.evaluate_every or max(1, config.ppo.iterations // CHECKPOINTS)
