"""The one place that makes an engine."""

from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.physics.types import Physics
from cassie_mjx.robot.model import ModelConfig, load_mjx_model, load_model

ENGINES = ("native", "mjx")
"""Engines by name: MuJoCo C on CPU threads, MJX on accelerators."""


def make_physics(engine: str, config: ModelConfig, max_delay: int = 0, threads: int = 0) -> Physics:
    """An engine for Cassie.

    Args:
      engine: one of `ENGINES`.
      config: scene, rate, contacts and solver.
      max_delay: longest delay that a scenario will ask for, physics steps.
      threads: of MuJoCo C; 0 for all cores.

    Raises:
      ValueError: there is no such engine, or its model cannot be compiled.
    """
    if engine == "native":
        return NativePhysics(load_model(config), max_delay, threads)
    if engine == "mjx":
        # Here, for whoever stays on MuJoCo C need not wait for it.
        from cassie_mjx.physics.mjx import MjxPhysics

        return MjxPhysics(load_mjx_model(config), max_delay)
    raise ValueError(f"physics={engine!r} is not known; choose one of {', '.join(ENGINES)}.")
