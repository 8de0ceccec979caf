"""A training run of seconds."""

import io
from dataclasses import replace

import pytest
from rich.console import Console

from cassie_mjx.ppo.config import PPOConfig
from cassie_mjx.training.config import TrainConfig
from cassie_mjx.training.runner import Runner

TINY = PPOConfig(
    num_robots=4,
    num_steps=8,
    iterations=2,
    updates_per_iteration=3,
    minibatch_size=16,
    hidden_sizes=(16, 16),
    normalizer_samples=64,
)

_CHANGED = {name: value for name, value in vars(TINY).items() if value != getattr(PPOConfig(), name)}
ARGUMENTS = ["evaluate_every=2", *(f"ppo.{name}={str(value).strip('()')}" for name, value in _CHANGED.items())]
"""The same on a command line."""


def config(folder, **changes):
    return replace(TrainConfig(ppo=TINY, physics="native", evaluate_every=2, run_dir=str(folder)), **changes)


def session(folder, **changes):
    return Runner(config(folder, **changes), Console(file=io.StringIO()))


def halt_after_one(folder, **changes):
    """Begin a run, and interrupt it after an iteration."""
    begun = session(folder, **changes)
    iterate = begun._iterate

    def iterate_and_stop():
        iterate()
        raise KeyboardInterrupt

    begun._iterate = iterate_and_stop
    with pytest.raises(KeyboardInterrupt):
        begun.train()
    begun._save()
