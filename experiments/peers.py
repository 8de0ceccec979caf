"""Our learner beside others: `python -m experiments.peers out=FILE.json`.

On MuJoCo C our learner stands beside Stable-Baselines3's PPO, which steps robots through our Gymnasium view; on
MJX beside Brax's PPO on our Brax environment. Ours is `python -m cassie_mjx.train` as it comes; the others have the
settings that their authors published for such tasks (`experiments/learners/`). All learn from the same reward, and all
are measured alike: the deterministic walk of `cassie_mjx.evaluation.returns` in MuJoCo C at 2 kHz, whose time does not
count. Samples are control steps, the states that our input statistics come from included; seconds include compilation,
which every run does anew.

Each run is a process of its own, which ends when it returns 250, or with its budget. Runs that are finished are not
repeated, so the same command completes what was stopped. Samples do not depend on what else the machine does, seconds
do: compare those only if it was quiet.
"""

import importlib.util
import json
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple

from rich.table import Table

from cassie_mjx import cli, starting
from cassie_mjx.cli.origin import version_of
from cassie_mjx.configuration.values import Checked, Range, Seed
from cassie_mjx.physics.make import ENGINES
from cassie_mjx.training import schedule
from cassie_mjx.training.config import TrainConfig, from_arguments

GOALS = (150, 250)
"""Plain returns, of 300."""

POLL_S = 0.5
"""Time between two looks at what a run has written, s."""


class Learner(NamedTuple):
    """A learner, and what it learns on."""

    physics: str
    module: str
    """What runs it."""
    packages: tuple[str, ...] = ()
    """Distributions of an extra of ours that it needs, the one that Python imports first."""


LEARNERS = {
    "ours": Learner("native", "cassie_mjx.train"),
    "sb3": Learner("native", "experiments.learners.sb3_ppo", ("stable-baselines3", "torch", "gymnasium")),
    "ours_mjx": Learner("mjx", "cassie_mjx.train"),
    "brax": Learner("mjx", "experiments.learners.brax_ppo"),
}
"""What can be compared; those on one engine with each other."""


@dataclass(frozen=True)
class PeersConfig(Checked):
    """What to compare."""

    CHOICES: ClassVar[Mapping[str, Collection[str]]] = {"learners": LEARNERS}

    learners: tuple[str, ...] = tuple(LEARNERS)
    """On MuJoCo C "ours" and "sb3", Stable-Baselines3; on MJX "ours_mjx" and "brax"."""
    seeds: tuple[Seed, ...] = (0, 1, 2)
    """Seeds of each learner."""
    samples: Annotated[int, Range(1, 10**12)] = 1_300_000
    """Control steps after which a learner has not reached a return; our default run has 1,278,976."""
    seconds: Annotated[float, Range(1, 10**7)] = 7200.0
    """Time in learning after which it has not, s."""
    train: tuple[str, ...] = ()
    """What our learner is told besides, such as [ppo=massive]; Brax has as many robots as ours."""
    runs: str = "runs/peers"
    """Directory of the runs, <learner>-seed<seed>."""
    out: str = "peers.json"
    """Result file."""
    overwrite: bool = False
    """Whether to replace a file that is no result of this experiment."""

    def __post_init__(self) -> None:
        """Raise ValueError for no learner, no seed, or what `cassie_mjx.train` would not take."""
        super().__post_init__()
        for name, example in (("learners", "ours"), ("seeds", "0")):
            if not getattr(self, name):
                raise ValueError(f"{name} is empty; name at least one, such as {name}={example}.")
        trained(self)


def trained(config: PeersConfig) -> TrainConfig:
    """Our learner's configuration. Raises ValueError for what `cassie_mjx.train` would not take."""
    return from_arguments(config.train)


def check_installed(learners: Collection[str]) -> None:
    """Raise ValueError if a learner needs a package that is not here."""
    for name in learners:
        for package in LEARNERS[name].packages:
            if importlib.util.find_spec(package.replace("-", "_")) is None:
                raise ValueError(
                    f"learners={name} needs the package {package}; pip install -c constraints.txt -e '.[peers]', or "
                    f"leave {name} out of learners."
                )


def physics_hz(learner: Learner) -> int:
    """Physics steps a second that a learner trains at: those of our own training."""
    return ENGINES[learner.physics].training.physics_hz


def settings(name: str, config: PeersConfig) -> dict[str, Any]:
    """What a finished run must have been made with to count."""
    hertz = physics_hz(LEARNERS[name])
    return {"samples": config.samples, "seconds": config.seconds, "train": list(config.train), "physics_hz": hertz}


def command(name: str, seed: int, folder: Path, config: PeersConfig) -> list[str]:
    """The command of one run."""
    learner, ours = LEARNERS[name], trained(config)
    told = {"seed": seed, "physics_hz": physics_hz(learner), "run_dir": folder}
    if learner.module == "cassie_mjx.train":
        told |= {"evaluate_every": schedule.period(ours)}
        arguments = [*config.train, f"physics={learner.physics}", "resume=true"]
    else:
        told |= {"samples": config.samples, "robots": ours.ppo.num_robots}
        told |= {"every": schedule.period(ours) * ours.ppo.num_samples}
        arguments = []
    return [sys.executable, "-m", learner.module, *arguments, *(f"{key}={value}" for key, value in told.items())]


def read_curve(name: str, folder: Path, config: PeersConfig) -> list[dict[str, float]]:
    """What a run has measured so far, budget or not: samples, train_s and return_plain."""
    path, ppo = folder / "metrics.jsonl", trained(config).ppo
    ours = LEARNERS[name].module == "cassie_mjx.train"
    before = -(-ppo.normalizer_samples // ppo.num_samples) * ppo.num_samples if ours else 0
    # A line that is being written has no end yet.
    lines = map(json.loads, path.read_text().split("\n")[:-1] if path.exists() else ())
    return [
        {
            "samples": int(line["train/samples"]) + before,
            "train_s": line["time/train_s"],
            "return_plain": line["eval/return_plain"],
        }
        for line in lines
        if "eval/return_plain" in line
    ]


def within(curve: list[dict[str, float]], config: PeersConfig) -> list[dict[str, float]]:
    """What of a curve lies within the budget."""
    return [point for point in curve if point["samples"] <= config.samples and point["train_s"] <= config.seconds]


def is_over(curve: list[dict[str, float]], config: PeersConfig) -> bool:
    """Whether a run has reached all goals, or has spent its budget."""
    counted = within(curve, config)
    return len(counted) < len(curve) or any(point["return_plain"] >= max(GOALS) for point in counted)


def learn(name: str, seed: int, config: PeersConfig) -> dict[str, Any]:
    """One run: its curve, settings and provenance; nothing is repeated if it is finished.

    Raises:
      ValueError: it was made with other settings, or ended with an error or a signal.
    """
    folder = Path(config.runs) / f"{name}-seed{seed}"
    finished = folder.with_name(f"{folder.name}.json")
    wanted = settings(name, config)
    if finished.exists():
        run = cli.read_json(finished, "move it away, and its run is made anew.")
        if run.get("settings") != wanted:
            raise ValueError(f"{finished} was made with {run.get('settings')}, not {wanted}; name another runs=.")
        return run
    folder.parent.mkdir(parents=True, exist_ok=True)
    _follow(command(name, seed, folder, config), lambda: is_over(read_curve(name, folder, config), config))
    packages = {package: version_of(package) for package in LEARNERS[name].packages}
    curve = within(read_curve(name, folder, config), config)
    run = {"learner": name, "seed": seed, "curve": curve, "settings": wanted}
    run |= {"provenance": cli.provenance(packages=packages)}
    cli.write_json(finished, run)
    return run


def _follow(arguments: list[str], is_over: Callable[[], bool]) -> None:
    """Run a command until it ends or is over."""
    environment = starting.environment() | {"JAX_ENABLE_COMPILATION_CACHE": "false"}
    with subprocess.Popen(arguments, env=environment) as run:
        try:
            while run.poll() is None and not is_over():
                time.sleep(POLL_S)
        except SystemExit:
            # SIGTERM is passed on; Ctrl-C reaches the run by itself.
            run.terminate()
            raise
        stopped = run.poll() is None
        if stopped:
            run.terminate()
        status = run.wait()
    if status and not stopped:
        raise ValueError(f"{' '.join(arguments[1:])} ended with status {status}.")


def row(run: Mapping[str, Any]) -> dict[str, Any]:
    """What a run came to: samples and seconds at the first measurement of each goal or more, None if there is none."""
    learner, curve = LEARNERS[run["learner"]], run["curve"]
    last = curve[-1] if curve else {"samples": 0, "train_s": 0.0}
    values: dict[str, Any] = {
        "learner": run["learner"],
        "physics": learner.physics,
        "physics_hz": run["settings"]["physics_hz"],
        "seed": run["seed"],
    }
    for goal in GOALS:
        first = next((point for point in curve if point["return_plain"] >= goal), None)
        for name in ("samples", "train_s"):
            values[f"{name}_to_{goal}"] = first and round(first[name], 1)
    best = max((point["return_plain"] for point in curve), default=None)
    return values | {"best_return_plain": best, "samples": last["samples"], "train_s": round(last["train_s"], 1)}


def table(rows: list[dict[str, Any]]) -> Table:
    """The rows for reading."""
    goals = [f"{quantity} to {goal}" for goal in GOALS for quantity in ("samples", "s")]
    shown = Table("learner", "physics", "seed", *goals, "best return", "after", title="Our learner beside others")
    for each in rows:
        cells = [each["learner"], f"{each['physics']} {each['physics_hz']} Hz", str(each["seed"])]
        for goal in GOALS:
            samples, seconds = each[f"samples_to_{goal}"], each[f"train_s_to_{goal}"]
            cells += ["not reached", ""] if samples is None else [f"{samples:,.0f}", f"{seconds:,.0f}"]
        best = each["best_return_plain"]
        cells += ["-" if best is None else f"{best:.1f}", f"{each['samples']:,} samples, {each['train_s']:,.0f} s"]
        shown.add_row(*cells)
    return shown


def main(config: PeersConfig) -> None:
    """Make the runs that are missing, then print and write what all of them came to."""
    out = cli.check_output(config.out, cli.RESULT, config.overwrite)
    check_installed(config.learners)
    runs = [learn(name, seed, config) for name in config.learners for seed in config.seeds]
    rows = [row(run) for run in runs]
    cli.console().print(table(rows))
    commits = sorted({run["provenance"]["commit"] for run in runs})
    provenance = cli.provenance(**asdict(config), commits_of_the_runs=commits)
    cli.write_result(out, {"rows": rows, "runs": runs, "provenance": provenance})


if __name__ == "__main__":
    cli.run(main, PeersConfig)
