"""Train a policy: `python -m cassie_mjx.train speed=1x`."""

from cassie_mjx.cli import hydra_line
from cassie_mjx.training.config import PRESETS, TrainConfig
from cassie_mjx.training.runner import train_policy


def main(config: TrainConfig) -> None:
    """Train one policy."""
    train_policy(config)


if __name__ == "__main__":
    hydra_line.run(main, TrainConfig, "train", PRESETS)
