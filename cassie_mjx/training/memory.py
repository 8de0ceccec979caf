"""What memory a run would take, told before it is asked for: a machine without it would stop, or end the process."""

import os
from itertools import pairwise
from pathlib import Path

import jax

from cassie_mjx.configuration.values import shown
from cassie_mjx.control.observation import OBSERVATIONS
from cassie_mjx.envs.config import WalkConfig
from cassie_mjx.ppo.config import PPOConfig
from cassie_mjx.robot import cassie

# Measured on MuJoCo C at the process' peak: 4.6 kB a sample of 80 numbers and 64 units, 54 B a weight, 110 kB a robot
# with a history of 27 kB. A robot's state on MJX has 40 kB. A GRU of 64 units takes 1.8 kB a sample more.
COPIES_OF_OBSERVATIONS, COPIES_OF_LAYERS, COPIES_OF_WEIGHTS, COPIES_OF_HISTORY = 12, 2, 13, 4
COPIES_OF_HIDDEN = 7
BYTES_OF_MJX_ROBOT = 80_000


def needed_bytes(ppo: PPOConfig, walk: WalkConfig, physics: str, physics_hz: int) -> int:
    """About what the largest arrays of a run take, over all devices."""
    widths, observed = ppo.hidden_sizes, OBSERVATIONS[walk.observation].size
    remembered = widths[0] if ppo.network == "gru" else 0
    layers = COPIES_OF_LAYERS * max(widths) + COPIES_OF_HIDDEN * remembered
    sample = 4 * (COPIES_OF_OBSERVATIONS * observed + layers)
    weights = sum(a * b for a, b in pairwise((observed, *widths, cassie.NU)))
    weights += remembered * (2 * observed + 3 * remembered)
    history = walk.delay_steps(physics_hz) + 1
    past = history * (cassie.NQ + cassie.NV + cassie.NU)
    robot = 8 * COPIES_OF_HISTORY * past + BYTES_OF_MJX_ROBOT * (physics == "mjx")
    return ppo.num_samples * sample + 4 * COPIES_OF_WEIGHTS * weights + ppo.num_robots * robot


def check_memory(ppo: PPOConfig, walk: WalkConfig, physics: str, physics_hz: int) -> None:
    """Raise ValueError if a run needs more memory than its devices have in all."""
    needed, present = needed_bytes(ppo, walk, physics, physics_hz), present_bytes(physics)
    if needed > present:
        raise ValueError(
            f"ppo.num_robots={ppo.num_robots}, ppo.num_steps={ppo.num_steps} and ppo.hidden_sizes="
            f"{shown(ppo.hidden_sizes)} would take about {needed / 1e9:,.0f} GB of memory, and there are "
            f"{present / 1e9:,.0f} GB; use smaller ones."
        )


def present_bytes(physics: str) -> int:
    """The memory of what an engine trains on: of all accelerators, or of this machine for each process."""
    device = jax.local_devices()[0]
    stats = device.memory_stats() if physics == "mjx" and device.platform != "cpu" else None
    if stats and "bytes_limit" in stats:
        return stats["bytes_limit"] * jax.device_count()
    # A container may have less than its machine.
    limit = Path("/sys/fs/cgroup/memory.max")
    limits = [int(limit.read_text())] if limit.is_file() and limit.read_text().strip().isdigit() else []
    return min([os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"), *limits]) * jax.process_count()
