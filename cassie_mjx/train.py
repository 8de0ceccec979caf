"""Train a policy: `python -m cassie_mjx.train speed=1x`."""

from cassie_mjx import cli
from cassie_mjx.training.config import PRESETS, RENAMED, TrainConfig, complete
from cassie_mjx.training.runner import train_policy


def main(config: TrainConfig) -> None:
    """Train one policy."""
    train_policy(config)


def run() -> None:
    """Read the command line, and do it."""
    cli.run(main, TrainConfig, {key: cli.Group(*presets) for key, presets in PRESETS.items()}, RENAMED, complete)


if __name__ == "__main__":
    run()
