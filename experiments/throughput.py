"""How fast both engines are: `python -m experiments.throughput out=FILE.json`.

Every robot walks on the spot under PD targets that swing its legs, so that feet land and leave the ground. MuJoCo C is
timed beside a bare loop in C over the same model and PD law on as many threads (`mujoco.rollout`, one call for all
control steps); the two take turns, and their ratio is taken turn by turn. Compile time stands apart.
"""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Any

import jax
import mujoco
import mujoco.rollout
import numpy as np

from cassie_mjx import cli
from cassie_mjx.configuration.values import Checked, Range, Seed
from cassie_mjx.physics.mjx import MjxPhysics
from cassie_mjx.physics.native import NativePhysics, cores
from cassie_mjx.physics.types import Physics, PhysicsState, Scenario
from cassie_mjx.robot import cassie
from cassie_mjx.robot.model import (
    MJX_TRAINING,
    ModelConfig,
    load_mjx_model,
    load_model,
    servo_model,
    standing,
    steps_per_control,
)


@dataclass(frozen=True)
class ThroughputConfig(Checked):
    """What to time."""

    out: str = "throughput.json"
    """Result file."""
    overwrite: bool = False
    """Whether to replace a file that is no result of this experiment."""
    native_robots: tuple[Annotated[int, Range(1, 100_000)], ...] = (1, 16, 64, 256)
    """Batch sizes for MuJoCo C; none if empty."""
    mjx_robots: tuple[Annotated[int, Range(1, 100_000)], ...] = (64, 256)
    """Batch sizes for MJX; none if empty."""
    control_steps: Annotated[int, Range(1, 10_000)] = 8
    """Control steps of 32 ms in each timed stretch."""
    turns: Annotated[int, Range(1, 1000)] = 5
    """Timed stretches on MuJoCo C, and half as many, three at least, on MJX; the median counts."""
    seed: Seed = 0
    """Seed of the gait phases."""


def swinging_targets(robots: int, control_steps: int, seed: int) -> np.ndarray:
    """PD targets [control_steps, robots, 10], rad: both legs lift in turn, 1.4 times a second, from random phases."""
    phase = 2 * np.pi * 1.4 * 0.032 * np.arange(control_steps)[:, None, None]
    phase = phase + np.random.default_rng(seed).uniform(0, 2 * np.pi, (1, robots, 1))
    lift = np.array([0.0, 0.0, 0.25, -0.45, 0.2])
    swing = np.concatenate([lift * np.sin(phase).clip(0), lift * np.sin(phase + np.pi).clip(0)], axis=-1)
    return cassie.STANDING_TARGET + swing


def walk_in_place(physics: Physics, state: PhysicsState, targets: np.ndarray, steps: int) -> PhysicsState:
    """Advance by one control step for each of `targets`."""
    undisturbed = Scenario.nominal(targets.shape[1])
    for target in targets:
        state = physics.advance(state, target, undisturbed, steps)
    return jax.block_until_ready(state)


def seconds(work: Callable[[], Any]) -> float:
    """Wall time of one call, s."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def bare_loop(config: ModelConfig, qpos: np.ndarray, targets: np.ndarray, threads: int) -> Callable[[], Any]:
    """The same walk by `mujoco.rollout`: all robots and steps in one call into C."""
    model = servo_model(load_model(config))
    spec = mujoco.mjtState.mjSTATE_FULLPHYSICS
    data = mujoco.MjData(model)
    states = np.empty((len(qpos), mujoco.mj_stateSize(model, spec)))
    for row, start in zip(states, qpos, strict=True):
        data.qpos[:] = start
        mujoco.mj_getState(model, data, row, spec)
    control = np.repeat(targets.transpose(1, 0, 2), steps_per_control(config.physics_hz), axis=1)
    workers = [mujoco.MjData(model) for _ in range(threads)]
    pool = mujoco.rollout.Rollout(nthread=threads)
    return lambda: pool.rollout(model, workers, states, control)


def time_native(config: ThroughputConfig, model: ModelConfig, robots: int, threads: int) -> dict[str, Any]:
    """Physics steps/s of `NativePhysics` and of the bare loop, turn about."""
    physics = NativePhysics(load_model(model), threads=threads)
    steps = steps_per_control(model.physics_hz)
    targets = swinging_targets(robots, config.control_steps, config.seed)
    qpos = np.tile(standing(physics.model), (robots, 1))
    start = physics.init(qpos, np.zeros((robots, cassie.NV)))
    bare = bare_loop(model, qpos, targets, threads)
    bare()
    walk_in_place(physics, start, targets, steps)
    pairs = [
        (seconds(lambda: walk_in_place(physics, start, targets, steps)), seconds(bare)) for _ in range(config.turns)
    ]
    total = robots * config.control_steps * steps
    return row("native", model, robots, [ours for ours, _ in pairs], total) | {
        "threads": threads,
        "bare_loop_steps_per_s": round(total / statistics.median(peer for _, peer in pairs)),
        "of_bare_loop": round(statistics.median(peer / ours for ours, peer in pairs), 3),
    }


def time_mjx(config: ThroughputConfig, model: ModelConfig, robots: int) -> dict[str, Any]:
    """Physics steps/s of `MjxPhysics`, and the seconds of its first call, which compiles."""
    physics = MjxPhysics(load_mjx_model(model), scene="flat")
    steps = steps_per_control(model.physics_hz)
    targets = swinging_targets(robots, config.control_steps, config.seed).astype(np.float32)
    qpos = np.tile(standing(physics.model), (robots, 1)).astype(np.float32)
    start = physics.init(qpos, np.zeros((robots, cassie.NV), np.float32))
    compile_s = seconds(lambda: walk_in_place(physics, start, targets[:1], steps))
    times = [seconds(lambda: walk_in_place(physics, start, targets, steps)) for _ in range(max(3, config.turns // 2))]
    return row("mjx", model, robots, times, robots * config.control_steps * steps) | {
        "device": jax.devices()[0].device_kind,
        "compile_s": round(compile_s, 1),
    }


def row(engine: str, model: ModelConfig, robots: int, times: list[float], physics_steps: int) -> dict[str, Any]:
    """One line of the result: median rate, and its spread over the turns."""
    rates = [physics_steps / t for t in times]
    return {
        "engine": engine,
        "robots": robots,
        "physics_hz": model.physics_hz,
        "contacts": model.contacts,
        "iterations": f"{model.iterations}/{model.ls_iterations}",
        "steps_per_s": round(statistics.median(rates)),
        "steps_per_s_min": round(min(rates)),
        "steps_per_s_max": round(max(rates)),
        "simulated_s_per_s": round(statistics.median(rates) / model.physics_hz, 1),
    }


def main(config: ThroughputConfig) -> None:
    """Time both engines and write the result."""
    out = cli.check_output(config.out, cli.RESULT, config.overwrite)
    # Each program is to be compiled, not loaded, so that its compile time means what it says.
    jax.config.update("jax_enable_compilation_cache", False)
    threads = cores()
    console = cli.console()
    rows = []
    for robots in config.native_robots:
        for model in (ModelConfig(), ModelConfig(physics_hz=1000), ModelConfig(physics_hz=500)):
            rows.append(time_native(config, model, robots, threads))
            console.print(rows[-1])
    largest = max(config.mjx_robots, default=0)
    published = replace(MJX_TRAINING, contacts="published")
    cases = [(MJX_TRAINING, robots) for robots in config.mjx_robots]
    cases += [(replace(MJX_TRAINING, contacts="walking"), largest), (published, largest)] if largest else []
    for model, robots in cases:
        rows.append(time_mjx(config, model, robots))
        console.print(rows[-1])
    cli.write_result(out, {"rows": rows, "provenance": cli.provenance(seed=config.seed)})


if __name__ == "__main__":
    cli.run(main, ThroughputConfig)
