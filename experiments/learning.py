"""Learning curves over seeds: `python -m experiments.learning study=walking out=FILE.json`.

A study trains each of its variants once a seed, one run after another, by `python -m cassie_mjx.train` on MuJoCo C, and
then reads what the runs wrote. Runs that are finished are not repeated and one that was interrupted goes on, so the
same command completes a study that was stopped; studies that share a variant share its runs. Returns do not depend on
what else the machine does, seconds do: compare those only if it was quiet. With `plot=FILE.png` the plain return is
drawn.
"""

import json
import statistics
import subprocess
import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from rich.table import Table

from cassie_mjx import cli, starting
from cassie_mjx.configuration.values import Checked
from cassie_mjx.reporting import plots
from cassie_mjx.reporting.spread import spread
from cassie_mjx.training import checkpoint
from experiments import pictures
from experiments.studies import STUDIES, Variant, deviations

# The return that the paper reports.
GOAL = 250
REWARDS = ("plain", "weighted")

COLUMNS = {
    "samples": "train/samples",
    "train_s": "time/train_s",
    "return_plain": "eval/return_plain",
    "return_weighted": "eval/return_weighted",
    "steps": "eval/steps",
    "nan": "train/nan",
    "low_reward": "train/low_reward",
    "kl": "learner/kl",
    "clip_fraction": "learner/clip_fraction",
    "explained_variance": "learner/explained_variance",
    "actor_learning_rate": "learner/actor_learning_rate",
}
"""Columns of a curve, one entry an evaluation, and where the metrics have them, if they do."""


@dataclass(frozen=True)
class LearningConfig(Checked):
    """What to study."""

    CHOICES: ClassVar[Mapping[str, Collection[str]]] = {"study": STUDIES}

    study: str = "walking"
    """What is compared with what; `STUDIES` has the variants and seeds of each."""
    runs: str = "runs/studies"
    """Directory of the run directories, <variant>-seed<seed>."""
    out: str = "learning.json"
    """Result file."""
    plot: str = ""
    """File for a picture of the curves; none if empty."""
    overwrite: bool = False
    """Whether to replace a file that is no result of this experiment."""


def is_finished(folder: Path) -> bool:
    """Whether the run directory holds the last checkpoint of its training."""
    last = checkpoint.latest(folder / "checkpoints")
    if last is None:
        return False
    iterations = json.loads((folder / "config.json").read_text())["config"]["ppo.iterations"]
    return checkpoint.iteration_of(last) == iterations


def train(folder: Path, variant: Variant, seed: int) -> None:
    """Train one run to its end; nothing happens if it is there already.

    Raises:
      ValueError: training ended with an error or a signal.
    """
    if is_finished(folder):
        return
    settings = variant.of(seed, folder.parent) | {"run_dir": str(folder), "resume": "true"}
    arguments = [f"{key}={value}" for key, value in settings.items()]
    command = [sys.executable, "-m", "cassie_mjx.train", *arguments]
    with subprocess.Popen(command, env=starting.environment()) as training:
        try:
            status = training.wait()
        except SystemExit:
            # SIGTERM is passed on: the training saves a checkpoint and ends. Ctrl-C reaches it by itself.
            training.terminate()
            raise
    if status:
        raise ValueError(f"Training in {folder} ended with status {status}; the same command goes on from there.")


def check(folder: Path, variant: Variant, seed: int) -> dict[str, Any]:
    """What a run's config.json holds: its configuration and provenance.

    Raises:
      ValueError: it was trained with other settings than the variant's, in whatever point, or is not finished.
    """
    if not is_finished(folder):
        raise ValueError(f"{folder} holds no finished training; `python -m experiments.learning` goes on with it.")
    held = json.loads((folder / "config.json").read_text())
    wrong = deviations(held["config"], variant, seed, folder.parent)
    if wrong:
        raise ValueError(f"{folder} was trained with {', '.join(wrong)}, unlike {variant.name}; move it away.")
    return held


def read(folder: Path, variant: Variant, seed: int) -> dict[str, Any]:
    """What a finished run did: its configuration, curve, returns, and samples and seconds to the goal.

    The returns are those of the last policy, which was not chosen by them.

    Raises:
      ValueError: it was trained with other settings than the variant's, in whatever point, or is not finished.
    """
    held = check(folder, variant, seed)
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    lines = [line for line in lines if COLUMNS["steps"] in line]
    curve = {name: [_rounded(line[key]) for line in lines] for name, key in COLUMNS.items() if key in lines[0]}
    return {
        "variant": variant.name,
        "seed": seed,
        **{f"return_{reward}": curve[f"return_{reward}"][-1] for reward in REWARDS},
        **{f"samples_to_{GOAL}_{reward}": to_goal(curve, reward, "samples") for reward in REWARDS},
        **{f"train_s_to_{GOAL}_{reward}": to_goal(curve, reward, "train_s") for reward in REWARDS},
        "physics_hz": held["config"]["physics_hz"],
        "curve": curve,
        **held,
    }


def to_goal(curve: dict[str, list[float]], reward: str, quantity: str) -> float | None:
    """`quantity` at the first evaluation whose return is `GOAL` or more; None if there is none."""
    reached = (i for i, value in enumerate(curve[f"return_{reward}"]) if value >= GOAL)
    first = next(reached, None)
    return None if first is None else curve[quantity][first]


def summarize(variant: Variant, runs: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """What the seeds of a variant say together; `n` of its `runs` have a value: reached the goal."""
    quantities = [
        *((f"return_{reward}", "of 300") for reward in REWARDS),
        *((f"samples_to_{GOAL}_{reward}", "samples") for reward in REWARDS),
        *((f"train_s_to_{GOAL}_{reward}", "s") for reward in REWARDS),
    ]
    rows = []
    for quantity, unit in quantities:
        values = [run[quantity] for run in runs if run[quantity] is not None]
        row = {"variant": variant.name, "physics_hz": runs[0]["physics_hz"], "quantity": quantity}
        rows.append(row | _summary(values) | {"unit": unit, "n": len(values), "runs": len(runs)})
    return rows


def _summary(values: Sequence[float]) -> dict[str, Any]:
    """What the seeds say together; nothing without any."""
    names = ("mean", "sd", "median", "iqm", "iqm_low", "iqm_high", "min", "max")
    if not values:
        return dict.fromkeys(names)
    found = spread(values)
    sd = statistics.stdev(values) if len(values) > 1 else None
    middle = (statistics.mean(values), sd, statistics.median(values))
    numbers = (*middle, found.iqm, *(found.interval or (None, None)), found.least, found.greatest)
    return {name: None if value is None else _rounded(value) for name, value in zip(names, numbers, strict=True)}


def table(title: str, rows: Sequence[dict[str, Any]]) -> Table:
    """The summary for reading: mean (least–greatest) over the seeds."""
    shown = Table("variant", "reward", "return", f"k samples to {GOAL}", f"s to {GOAL}", "reached", title=title)
    found = {(row["variant"], row["quantity"]): row for row in rows}
    for variant in dict.fromkeys(row["variant"] for row in rows):
        for reward in REWARDS:
            kept, samples, seconds = (
                found[variant, f"{quantity}_{reward}"]
                for quantity in ("return", f"samples_to_{GOAL}", f"train_s_to_{GOAL}")
            )
            reached = f"{samples['n']} of {samples['runs']}"
            shown.add_row(variant, reward, _span(kept, 1, 1), _span(samples, 1000, 0), _span(seconds, 1, 0), reached)
    return shown


def _span(row: dict[str, Any], unit: float, digits: int) -> str:
    if not row["n"]:
        return "-"
    mean, least, greatest = (f"{row[name] / unit:.{digits}f}" for name in ("mean", "min", "max"))
    return f"{mean} ({least}–{greatest})"


def main(config: LearningConfig) -> None:
    """Train what is missing, then write the result and draw it."""
    out = cli.check_output(config.out, cli.RESULT, config.overwrite)
    plot = pictures.check(config.plot, config.overwrite, out) if config.plot else None
    console = cli.console()
    rows, runs = [], []
    for variant in STUDIES[config.study]:
        for seed in variant.seeds:
            folder = Path(config.runs) / f"{variant.name}-seed{seed}"
            train(folder, variant, seed)
            # Where the runs lie on one machine tells no other one anything.
            text = json.dumps(read(folder, variant, seed)).replace(str(Path(config.runs).resolve()), config.runs)
            runs.append(json.loads(text))
        rows += summarize(variant, runs[-len(variant.seeds) :])
    console.print(table(config.study, rows))
    commits = sorted({run["provenance"]["commit"] for run in runs})
    provenance = cli.provenance(study=config.study, commits_of_the_runs=commits)
    if commits != [provenance["commit"]]:
        console.print(f"The runs were made at {', '.join(commits)}, not at {provenance['commit']}.")
    cli.write_result(out, {"rows": rows, "runs": runs, "provenance": provenance})
    if plot:
        pictures.save_figure(config.plot, plot, plots.learning(runs, "samples"), dpi=150)


def _rounded(value: float) -> float:
    return float(f"{value:.8g}")


if __name__ == "__main__":
    cli.run(main, LearningConfig)
