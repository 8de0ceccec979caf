"""The one place that makes an engine; a new one is a line of `ENGINES`."""

from collections.abc import Callable
from typing import NamedTuple

from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.physics.types import Physics
from cassie_mjx.robot.electronics import torque_delay_steps
from cassie_mjx.robot.model import MJX_TRAINING, NATIVE_TRAINING, ModelConfig, load_mjx_model, load_model


class Engine(NamedTuple):
    """How an engine is made, and what it trains on."""

    make: Callable[[ModelConfig, int, int], Physics]
    """As `make_physics`, less the name."""
    training: ModelConfig
    """Rate and solver of training, unless told otherwise."""


def make_physics(engine: str, config: ModelConfig, max_delay: int = 0, threads: int = 0) -> Physics:
    """An engine for Cassie.

    Args:
      engine: one of `ENGINES`.
      config: scene, rate, contacts, solver, and whether there are electronics.
      max_delay: longest delay that a scenario will ask for, physics steps.
      threads: of MuJoCo C; 0 for all cores.

    Raises:
      ValueError: there is no such engine, or its model cannot be compiled.
    """
    check_engine(engine)
    if config.electronics:
        max_delay = max(max_delay, torque_delay_steps(config.physics_hz))
    return ENGINES[engine].make(config, max_delay, threads)


def check_engine(engine: str) -> None:
    """Raise ValueError unless there is an engine of that name."""
    if engine not in ENGINES:
        raise ValueError(f"physics={engine!r} is not known; choose one of {', '.join(ENGINES)}.")


def _native(config: ModelConfig, max_delay: int, threads: int) -> Physics:
    return NativePhysics(load_model(config), max_delay, threads, config.electronics)


def _mjx(config: ModelConfig, max_delay: int, threads: int) -> Physics:
    # Here, for whoever stays on MuJoCo C need not wait for it.
    from cassie_mjx.physics.mjx import MjxPhysics

    return MjxPhysics(load_mjx_model(config), max_delay, config.scene, electronics=config.electronics)


ENGINES = {
    "native": Engine(_native, NATIVE_TRAINING),
    "mjx": Engine(_mjx, MJX_TRAINING),
}
"""Engines by name: MuJoCo C on CPU threads, MJX on accelerators."""
