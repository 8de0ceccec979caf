"""Train a policy: `python -m cassie_mjx.train speed=1x`."""

import os

import mujoco
from rich.console import Console

from cassie_mjx.cli import hydra_line
from cassie_mjx.training import devices
from cassie_mjx.training.config import PRESETS, TrainConfig
from cassie_mjx.training.runner import Session


def main(config: TrainConfig) -> None:
    """Train one policy."""
    # On few cores, XLA's threads take time from the physics' threads; it reads this when it makes its first array.
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")
    # Divergences are counted, and the first is kept; MuJoCo would print hundreds of lines about each.
    mujoco.set_mju_user_warning(lambda _: None)
    if config.distributed:
        devices.join()
    Session(config, Console(quiet=not devices.is_first())).train()


if __name__ == "__main__":
    hydra_line.run(main, TrainConfig, "train", PRESETS)
