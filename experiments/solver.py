"""What the solver's settings cost and hold: `python -m experiments.solver out=FILE.json`.

For each engine, rate and number of solver iterations: the largest distance between the two anchors of a loop while the
robot lifts its legs in turn, how many robots went to NaN, and the physics steps/s. Beside them the published settings
of the loops (solref 0.005 1 with MuJoCo's default solimp) at 2 kHz.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any

import jax
import numpy as np

from cassie_mjx import cli
from cassie_mjx.configuration.values import Checked, Range, Seed
from cassie_mjx.physics.mjx import MjxPhysics
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.physics.types import Physics, Scenario
from cassie_mjx.robot import cassie
from cassie_mjx.robot.loops import loop_error
from cassie_mjx.robot.model import ModelConfig, load_mjx_model, load_model, standing, steps_per_control
from experiments.throughput import seconds, swinging_targets

PUBLISHED_SOLIMP = (0.9, 0.95, 0.001)


@dataclass(frozen=True)
class SolverConfig(Checked):
    """What to measure."""

    out: str = "solver.json"
    """Result file."""
    overwrite: bool = False
    """Whether to replace a file that is no result of this experiment."""
    robots: Annotated[int, Range(1, 10_000)] = 32
    """Robots, each in its own phase of the motion."""
    control_steps: Annotated[int, Range(1, 10_000)] = 18
    """Control steps of 32 ms; none of the robots falls so soon."""
    seed: Seed = 0
    """Seed of the phases."""


def measure(config: SolverConfig, engine: str, model: ModelConfig, physics: Physics, loops: str) -> dict[str, Any]:
    """Loop error and speed of one engine with one set of settings."""
    dtype = np.float32 if engine == "mjx" else np.float64
    steps = steps_per_control(model.physics_hz)
    targets = swinging_targets(config.robots, config.control_steps, config.seed).astype(dtype)
    qpos = np.tile(standing(physics.model), (config.robots, 1)).astype(dtype)
    start = physics.init(qpos, np.zeros((config.robots, cassie.NV), dtype))
    undisturbed = Scenario.nominal(config.robots)

    def walk() -> Iterator[np.ndarray]:
        state = start
        for target in targets:
            state = jax.block_until_ready(physics.advance(state, target, undisturbed, steps))
            yield np.asarray(state.qpos, float)

    trajectory = np.array(list(walk()))
    fell = int((trajectory[:, :, 2].min(axis=0) < 0.6).sum())
    broken = int(np.isnan(trajectory).any(axis=(0, 2)).sum())
    error_mm = 1000 * loop_error(physics.model, trajectory[~np.isnan(trajectory).any(axis=2)])
    took = min(seconds(lambda: list(walk())) for _ in range(3))
    return {
        "engine": engine,
        "physics_hz": model.physics_hz,
        "iterations": f"{model.iterations}/{model.ls_iterations}",
        "contacts": model.contacts,
        "loops": loops,
        "loop_error_max_mm": round(float(error_mm.max()), 3),
        "loop_error_mean_mm": round(float(error_mm.mean()), 3),
        "robots_nan": broken,
        "robots_fallen": fell,
        "steps_per_s": round(config.robots * config.control_steps * steps / took),
    }


def main(config: SolverConfig) -> None:
    """Measure every setup and write the table."""
    out = cli.check_output(config.out, cli.RESULT, config.overwrite)
    console = cli.console()
    rows = []

    def add(*case: Any) -> None:
        rows.append(measure(config, *case))
        console.print(rows[-1])

    published = load_model(ModelConfig())
    published.eq_solimp[:, :3] = PUBLISHED_SOLIMP
    add("native", ModelConfig(), NativePhysics(published), "published")
    for hz in (2000, 1000, 500):
        for iterations in (2, 4, 100):
            model = ModelConfig(physics_hz=hz, iterations=iterations)
            add("native", model, NativePhysics(load_model(model)), "ours")
        for iterations, ls_iterations in ((1, 2), (2, 2), (3, 2), (4, 3), (8, 8)):
            model = ModelConfig(physics_hz=hz, iterations=iterations, ls_iterations=ls_iterations)
            add("mjx", model, MjxPhysics(load_mjx_model(model), scene="flat"), "ours")
    cli.write_result(out, {"rows": rows, "provenance": cli.provenance(seed=config.seed)})


if __name__ == "__main__":
    cli.run(main, SolverConfig)
