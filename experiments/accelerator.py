"""What an accelerator makes of MJX, within a time budget: `python -m experiments.accelerator out=FILE.json`.

Throughput and memory over numbers of robots on the models of training and testing, agreement with MuJoCo C with and
without full-precision products, a training from scratch, and XLA's flags one at a time. Each part is a process of its
own, for XLA reads its flags once; a part that would not fit into the budget, or fails, is named in the result. Brax's
PPO beside ours is `experiments.peers learners=ours_mjx,brax`.
"""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp

from cassie_mjx import cli
from cassie_mjx.configuration.values import Checked, Range, Seed
from cassie_mjx.robot.model import MJX_TESTING, MJX_TRAINING
from experiments.agreement import AgreementConfig, compare_motion
from experiments.throughput import ThroughputConfig, time_mjx

GOALS = (250, 280)
"""Plain returns, of 300."""
MODELS = {"training": MJX_TRAINING, "testing": MJX_TESTING}
FLAGS = (
    {},
    {"XLA_FLAGS": "--xla_gpu_enable_command_buffer=+WHILE"},
    {"XLA_FLAGS": "--xla_gpu_graph_min_graph_size=1"},
    {"XLA_FLAGS": "--xla_gpu_enable_triton_gemm=false"},
)
"""Variables of the environment to try; the first is the baseline."""


@dataclass(frozen=True)
class AcceleratorConfig(Checked):
    """What to measure."""

    out: str = "accelerator.json"
    """Result file; it is written anew after each part."""
    overwrite: bool = False
    """Whether to replace a file that is no result of this experiment."""
    seconds: Annotated[float, Range(1, 86_400)] = 450.0
    """Time for all parts together, s."""
    robots: tuple[Annotated[int, Range(1, 1_000_000)], ...] = (1024, 2048, 4096, 8192, 16_384)
    """Numbers of robots to time; the flags are tried with the one in the middle."""
    control_steps: Annotated[int, Range(1, 10_000)] = 8
    """Control steps of 32 ms in each timed stretch."""
    train: tuple[str, ...] = ("ppo=massive",)
    """What the training is told besides."""
    seed: Seed = 0
    """Seed of gait phases, velocities and training."""

    def __post_init__(self) -> None:
        """Raise ValueError if there is nothing to time."""
        super().__post_init__()
        if not self.robots:
            raise ValueError("robots is empty; name at least one number, such as robots=1024.")


@dataclass(frozen=True)
class Part:
    """One process' share of the work."""

    name: str
    work: str
    """Name in `WORK`."""
    arguments: Mapping[str, Any]
    """Of the function there."""
    least_s: float
    """Not begun with less time than this, s."""
    most_s: float
    """Stopped after this, s; the rows that it had come to are kept."""
    environment: Mapping[str, str] = field(default_factory=dict)
    """Variables on top of ours."""


def throughput(model: str, robots: list[int], control_steps: int, seed: int) -> Iterator[dict[str, Any]]:
    """Physics steps/s, compile time and peak of the memory so far, a row for each number of robots."""
    jax.config.update("jax_enable_compilation_cache", False)
    timing = ThroughputConfig(control_steps=control_steps, turns=6, seed=seed)
    for count in robots:
        row = time_mjx(timing, MODELS[model], count)
        stats = jax.local_devices()[0].memory_stats() or {}
        yield {"model": model, **row, "peak_bytes": stats.get("peak_bytes_in_use")}


def agreement(robots: int, seed: int) -> Iterator[dict[str, Any]]:
    """Differences from MuJoCo C after 1 and 10 control steps, at both precisions of products."""
    for precision in ("highest", "default"):
        for row in compare_motion(AgreementConfig(robots=robots, seed=seed), 1.0, precision):
            yield {"precision": precision, **row}


def device() -> Iterator[dict[str, Any]]:
    """What JAX computes on, and the speed of a large product there."""
    first = jax.local_devices()[0]
    yield {
        "backend": jax.default_backend(),
        "kind": first.device_kind,
        "devices": jax.device_count(),
        "bytes": (first.memory_stats() or {}).get("bytes_limit"),
        "sum": float(jnp.ones(8).sum()),
    }


def training(arguments: list[str], seconds: float) -> Iterator[dict[str, Any]]:
    """A training until the last goal is reached, or its time is over: samples/s, and when it reached each goal."""
    with tempfile.TemporaryDirectory() as folder:
        words = ["physics=mjx", "evaluate_every=5", "log=jsonl", *arguments, f"run_dir={folder}/run"]
        started, metrics = time.monotonic(), Path(folder) / "run" / "metrics.jsonl"
        with subprocess.Popen([sys.executable, "-m", "cassie_mjx.train", *words], stdout=subprocess.DEVNULL) as run:
            while run.poll() is None and time.monotonic() - started < seconds and best(metrics) < GOALS[-1]:
                time.sleep(0.2)
            run.send_signal(signal.SIGTERM)
            try:
                run.wait(timeout=20)
            except subprocess.TimeoutExpired:
                run.kill()
        yield {"wall_s": round(time.monotonic() - started, 1), **reached(curve(metrics))}


def curve(metrics: Path) -> list[dict[str, float]]:
    """Lines of a run's metrics; none if it wrote none."""
    lines = metrics.read_text().splitlines(keepends=True) if metrics.exists() else []
    # The last may be half written.
    return [json.loads(line) for line in lines if line.endswith("\n")]


def best(metrics: Path) -> float:
    """The highest plain return of a run so far."""
    return max((line["eval/return_plain"] for line in curve(metrics)), default=0.0)


def reached(lines: list[dict[str, float]]) -> dict[str, Any]:
    """When a training first returned each of `GOALS`, and how fast it was."""
    found: dict[str, Any] = {"evaluations": len(lines)}
    for goal in GOALS:
        first = next((line for line in lines if line["eval/return_plain"] >= goal), None)
        found[f"samples_to_{goal}"] = first and first["train/samples"]
        found[f"train_s_to_{goal}"] = first and round(first["time/train_s"], 1)
    if lines:
        found |= {"return_plain": lines[-1]["eval/return_plain"], "samples_per_s": lines[-1]["time/samples_per_s"]}
    return found


WORK: dict[str, Callable[..., Iterator[dict[str, Any]]]] = {
    each.__name__: each for each in (device, throughput, agreement, training)
}


def parts(config: AcceleratorConfig) -> list[Part]:
    """The parts, the most telling first."""
    timing = {"control_steps": config.control_steps, "seed": config.seed}
    middle = config.robots[len(config.robots) // 2]
    timed = {
        model: Part(f"throughput, {model}", "throughput", {"model": model, "robots": config.robots, **timing}, 20, 120)
        for model in MODELS
    }
    train = {"arguments": [*config.train, f"seed={config.seed}"], "seconds": 140}
    flags = [
        Part(
            f"flags, {' '.join(f'{name}={value}' for name, value in flag.items()) or 'none'}",
            "throughput",
            {"model": "training", "robots": [middle], **timing},
            15,
            60,
            flag,
        )
        for flag in FLAGS
    ]
    return [
        Part("device", "device", {}, 5, 60),
        timed["training"],
        Part("agreement", "agreement", {"robots": 16, "seed": config.seed}, 20, 60),
        Part("training", "training", train, 40, 170),
        timed["testing"],
        *flags,
    ]


def run_part(part: Part, seconds: float) -> tuple[list[dict[str, Any]], str | None]:
    """Rows of a part in a process of its own, and what became of it if it did not come to its end."""
    program = "import sys; from experiments import accelerator; accelerator.work(*sys.argv[1:])"
    arguments = dict(part.arguments)
    if "seconds" in arguments:
        arguments["seconds"] = min(arguments["seconds"], max(seconds - 30, 1))
    flags = " ".join(filter(None, (os.environ.get("XLA_FLAGS"), part.environment.get("XLA_FLAGS"))))
    environment = {**os.environ, **part.environment, **({"XLA_FLAGS": flags} if flags else {})}
    words = [sys.executable, "-c", program, part.work, json.dumps(arguments)]
    with tempfile.TemporaryFile("w+") as output, tempfile.TemporaryFile("w+") as errors:
        child = subprocess.Popen(words, env=environment, stdout=output, stderr=errors, start_new_session=True)
        try:
            status = child.wait(timeout=seconds)
            why = None if status == 0 else f"ended with status {status}"
        except subprocess.TimeoutExpired:
            why = f"not done after {seconds:.0f} s"
        finally:
            # With what it started.
            if child.poll() is None:
                os.killpg(child.pid, signal.SIGKILL)
                child.wait()
        output.seek(0)
        errors.seek(0)
        lines = errors.read().splitlines()
        rows = [json.loads(line) for line in output.read().splitlines() if line.startswith("{") and line.endswith("}")]
    return rows, f"{why}: {lines[-1][:200]}" if why and lines else why


def work(name: str, arguments: str) -> None:
    """Print the rows of a part, one JSON object a line; what `run_part` calls."""
    for row in WORK[name](**json.loads(arguments)):
        print(json.dumps(row), flush=True)


def main(config: AcceleratorConfig) -> None:
    """Measure part after part while there is time."""
    out, console = cli.check_output(config.out, cli.RESULT, config.overwrite), cli.console()
    end = time.monotonic() + config.seconds
    rows, skipped = [], []
    for part in parts(config):
        began = time.monotonic()
        left = end - began
        if left < part.least_s:
            why, found = f"{max(left, 0):.0f} s were left, and it takes {part.least_s:.0f} s or more", []
        else:
            found, why = run_part(part, min(left, part.most_s))
        spent = round(time.monotonic() - began, 1)
        rows += [{"part": part.name, "part_s": spent, **row} for row in found]
        skipped += [{"part": part.name, "why": why}] if why else []
        console.print(part.name, f"{spent} s", why or "", *found)
        content = {"rows": rows, "skipped": skipped, "config": asdict(replace(config, out="", overwrite=False))}
        cli.write_result(out, content | {"provenance": cli.provenance(seed=config.seed)})


if __name__ == "__main__":
    cli.run(main, AcceleratorConfig)
