"""How training on MuJoCo C gains from cores: `python -m experiments.cores out=FILE.json`.

The first iterations of a training are timed in processes that may use 1, 2, ... cores of this machine. From those with
the most, the time on other numbers of cores n is computed, not measured: with B robots it is

    iteration = physics x ceil(B / n) / B + rest

where physics is what all robots take on one core, a robot being one thread's at a time, and rest is all else: policy,
task and learner. Beyond four cores the learner computes on several, so that rest is an upper bound.
"""

import math
import multiprocessing
import os
import statistics
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from typing import Annotated, Any

import jax
from rich.table import Table

from cassie_mjx import cli
from cassie_mjx.configuration.values import Checked, Range, shown
from cassie_mjx.motion.files import load_motion
from cassie_mjx.physics.native import cores
from cassie_mjx.training.config import TrainConfig, from_arguments, resolve_config
from cassie_mjx.training.devices import share_cores
from cassie_mjx.training.trainer import Trainer

Count = Annotated[int, Range(1, 4096)]


@dataclass(frozen=True)
class CoresConfig(Checked):
    """What to time."""

    measure: tuple[Count, ...] = (1, 2)
    """Numbers of cores to measure with."""
    compute: tuple[Count, ...] = (4, 8, 16, 32, 64)
    """Numbers of cores to compute the time for."""
    iterations: Annotated[int, Range(1, 10_000)] = 10
    """Timed iterations, after one that compiles; the median counts."""
    train: tuple[str, ...] = ()
    """What training is told besides, such as [ppo.num_robots=1024,ppo.minibatch_size=4096]."""
    out: str = "cores.json"
    """Result file."""
    overwrite: bool = False
    """Whether to replace a file that is no result of this experiment."""

    def __post_init__(self) -> None:
        """Raise ValueError for no number of cores, or what training would not take."""
        super().__post_init__()
        if not self.measure:
            raise ValueError("measure is empty; name at least one number of cores, such as measure=1.")
        trained(self)


def check_cores(config: CoresConfig) -> None:
    """Raise ValueError unless this machine can be measured with as many cores."""
    if not hasattr(os, "sched_setaffinity"):
        raise ValueError("This system cannot keep a process to some of its cores; measure on Linux.")
    if max(config.measure) > cores():
        raise ValueError(f"measure={shown(config.measure)} is more than the {cores()} cores that can be used here.")


def trained(config: CoresConfig) -> TrainConfig:
    """What is trained. Raises ValueError for what `cassie_mjx.train` would not take."""
    told = [*config.train, "physics=native"]
    return from_arguments(told)


def time_training(config: CoresConfig, count: int) -> dict[str, Any]:
    """One row, measured in this process, which has `count` cores from now on."""
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:count])
    share_cores()
    train = resolve_config(trained(config))
    trainer = Trainer(train, load_motion(train.reference))
    run, _ = trainer.iterate(trainer.start())
    trainer.timer.since_last()
    whole, physics = [], []
    for _ in range(config.iterations):
        began = time.perf_counter()
        run, _ = jax.block_until_ready(trainer.iterate(run))
        whole.append(time.perf_counter() - began)
        physics.append(trainer.timer.since_last()["physics"])
    rest = [a - b for a, b in zip(whole, physics, strict=True)]
    return row(train, count, statistics.median(physics), statistics.median(rest), "measured")


def row(train: TrainConfig, count: int, physics_s: float, rest_s: float, origin: str) -> dict[str, Any]:
    """One line of the result, of an iteration."""
    return {
        "cores": count,
        "robots": train.ppo.num_robots,
        "physics_s": round(physics_s, 4),
        "rest_s": round(rest_s, 4),
        "samples_per_s": round(train.ppo.num_samples / (physics_s + rest_s)),
        "origin": origin,
    }


def computed(train: TrainConfig, measured: dict[str, Any], count: int) -> dict[str, Any]:
    """The row of `count` cores, from a measured one."""
    robots = train.ppo.num_robots
    one_core = measured["physics_s"] * robots / math.ceil(robots / measured["cores"])
    return row(train, count, one_core * math.ceil(robots / count) / robots, measured["rest_s"], "computed")


def table(rows: list[dict[str, Any]]) -> Table:
    """The rows for reading."""
    shown = Table("cores", "robots", "physics, s", "rest, s", "samples/s", "", title="An iteration of training")
    for each in rows:
        times = f"{each['physics_s']:.3f}", f"{each['rest_s']:.3f}", f"{each['samples_per_s']:,}"
        shown.add_row(str(each["cores"]), str(each["robots"]), *times, each["origin"])
    return shown


def main(config: CoresConfig) -> None:
    """Measure, compute, print and write."""
    out = cli.check_output(config.out, cli.RESULT, config.overwrite)
    check_cores(config)
    rows = []
    for count in config.measure:
        # A process of its own, for JAX takes its threads once.
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
            rows.append(process.submit(time_training, config, count).result())
    last = max(rows, key=lambda each: each["cores"])
    rows += [computed(trained(config), last, count) for count in config.compute]
    cli.console().print(table(rows))
    cli.write_result(out, {"rows": rows, "provenance": cli.provenance(**asdict(config))})


if __name__ == "__main__":
    cli.run(main, CoresConfig)
