"""Measure a walker: `python -m cassie_mjx.evaluate policy=controller:stiff suite=all out=FILE.json`.

Every figure comes from MuJoCo C at 2 kHz with the referee's contacts, and starts from steady walking. Nothing is drawn
at random: the same command gives the same figures.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np
from rich.console import Console
from rich.status import Status
from rich.table import Table

from cassie_mjx import cli, subjects
from cassie_mjx.model import ModelConfig, load
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.sweeps import (
    AFTER_PUSH_S,
    PUSH_S,
    EpisodeResult,
    Key,
    Measured,
    Subject,
    Trial,
    Watch,
    conduct,
    fly,
)

SUITES = ("walk", "push", "terrain")

WALK_S, LONG_WALK_S = 10.0, 60.0
WALK_PHASES = np.arange(10) / 10
LIMIT_PHASES = np.arange(8) / 8
PUSH_STEP_N, LARGEST_PUSH_N = 10, 400
DIRECTIONS = {"forward": (1, 0), "backward": (-1, 0), "left": (0, 1), "right": (0, -1)}
TERRAIN_STEP_M, HIGHEST_TERRAIN_M = 0.01, 0.4
TERRAIN_S = 10.0


@dataclass(frozen=True)
class EvaluateConfig:
    """What to measure."""

    policy: str = "controller:compliant"
    """What walks: "controller:stiff", "controller:compliant", a policy's .npz file, or a run's directory (its best)."""
    suite: str = "all"
    """"walk", "push", "terrain", or "all" of them."""
    long: bool = False
    """Whether the walk of 10 s is followed by one of 60 s, whose quantities end in _60s."""
    physics: str = "native"
    """The engine; "native" is MuJoCo C at 2 kHz."""
    out: str = "evaluation.json"
    """Result file."""

    def __post_init__(self) -> None:
        """Raise ValueError for a suite or engine that is not known."""
        for name, valid in (("suite", (*SUITES, "all")), ("physics", ("native",))):
            value = getattr(self, name)
            if value not in valid:
                raise ValueError(f"{name}={value!r} is not known; choose one of {', '.join(valid)}.")


class LimitSearch:
    """Trials that find how many levels of a disturbance each group survives without a gap, from the smallest level up.

    The level begun next is the smallest that is open in any group. Once a level has failed, no larger one of its group
    is begun, flown to its end or counted, even if its robot is still up.
    """

    def __init__(self, trial: Callable[[int, int], Trial], groups: int, levels: int, together: bool = False) -> None:
        """Make a search.

        Args:
          trial: the trial of (group, level), both counted from 0.
          groups: number of groups, such as directions x phases.
          levels: number of levels.
          together: whether a failure in one group is a failure of all.
        """
        self.trial, self.together = trial, together
        self.begun = np.zeros(groups, int)
        self.limit = np.full(groups, levels)
        """For each group the smallest level failed, which is the number of levels survived once the search is over."""

    def next(self) -> tuple[Key, Trial] | None:
        """See `Trials.next`."""
        open_groups = np.flatnonzero(self.begun < self.limit)
        if not len(open_groups):
            return None
        group = int(open_groups[np.argmin(self.begun[open_groups])])
        level = int(self.begun[group])
        self.begun[group] += 1
        return (group, level), self.trial(group, level)

    def wanted(self, key: Key) -> bool:
        """See `Trials.wanted`."""
        group, level = key
        return level < self.limit[group]

    def ended(self, key: Key, result: EpisodeResult) -> None:
        """See `Trials.ended`."""
        group, level = key
        if result.fell:
            failed = slice(None) if self.together else group
            self.limit[failed] = np.minimum(self.limit[failed], level)


def walk(subject: Subject, long: bool, watch: Watch) -> list[Measured]:
    """Undisturbed walking on the flat from ten phases of the stride."""
    physics = NativePhysics(load(ModelConfig()))
    starts = subject.start(physics, WALK_PHASES)
    figures = subject.returns()
    for seconds, suffix in ((WALK_S, ""), (LONG_WALK_S, "_60s"))[: 1 + long]:
        trials = [Trial(start, seconds) for start in range(len(WALK_PHASES))]
        figures += walking_figures(fly(subject, physics, starts, trials, watch), suffix)
    return figures


def walking_figures(result: EpisodeResult, suffix: str = "") -> list[Measured]:
    """The shortest survival and the largest drift over the trials, and means of the rest."""
    return [
        Measured(quantity + suffix, float(value), unit, len(result.fell))
        for quantity, value, unit in (
            ("survived_s", result.survived_s.min(), "s"),
            ("speed_mps", result.speed_mps.mean(), "m/s"),
            ("pelvis_height_m", result.height_m.mean(), "m"),
            ("power_w", result.power_w.mean(), "W"),
            ("drift_m", np.abs(result.drift_m).max(), "m"),
        )
    ]


def push(subject: Subject, watch: Watch) -> list[Measured]:
    """The largest push of 0.2 s in each direction, at the worst of eight phases and in the median; at most 400 N."""
    physics = NativePhysics(load(ModelConfig()))
    starts = subject.start(physics, LIMIT_PHASES)
    groups = [(direction, phase) for direction in DIRECTIONS.values() for phase in range(len(LIMIT_PHASES))]

    def trial(group: int, level: int) -> Trial:
        (forward, left), phase = groups[group]
        force = PUSH_STEP_N * (level + 1)
        return Trial(phase, PUSH_S + AFTER_PUSH_S, push=(force * forward, force * left))

    search = LimitSearch(trial, len(groups), LARGEST_PUSH_N // PUSH_STEP_N)
    conduct(subject, physics, starts, search, watch=watch)
    return push_figures(PUSH_STEP_N * search.limit.reshape(len(DIRECTIONS), -1))


def push_figures(limits: np.ndarray) -> list[Measured]:
    """Worst and median phase of the limits [direction, phase], N."""
    worst = [(f"push_{name}_N", row.min(), len(row)) for name, row in zip(DIRECTIONS, limits, strict=True)]
    median = [(f"push_{name}_median_N", np.median(row), len(row)) for name, row in zip(DIRECTIONS, limits, strict=True)]
    return [Measured(name, float(value), "N", n) for name, value, n in worst + median]


def terrain(subject: Subject, watch: Watch) -> list[Measured]:
    """The largest h, at most 0.4 m, of the terrain z = h sin x that is survived from all of eight phases."""
    starts = subject.start(NativePhysics(load(ModelConfig())), LIMIT_PHASES)
    physics = NativePhysics(load(ModelConfig(scene="terrain")))

    def trial(phase: int, level: int) -> Trial:
        return Trial(phase, TERRAIN_S, terrain=TERRAIN_STEP_M * (level + 1))

    levels = round(HIGHEST_TERRAIN_M / TERRAIN_STEP_M)
    search = LimitSearch(trial, len(LIMIT_PHASES), levels, together=True)
    conduct(subject, physics, starts, search, watch=watch)
    return [Measured("terrain_h_m", round(TERRAIN_STEP_M * int(search.limit.min()), 9), "m", len(LIMIT_PHASES))]


def main(config: EvaluateConfig) -> None:
    """Measure, write the result and show it."""
    out = cli.check_writable(config.out)
    console = Console(stderr=True)
    subject = subjects.resolve(config.policy)
    measure: dict[str, Callable[[Watch], list[Measured]]] = {
        "walk": lambda watch: walk(subject, config.long, watch),
        "push": lambda watch: push(subject, watch),
        "terrain": lambda watch: terrain(subject, watch),
    }
    rows: list[dict[str, Any]] = []
    for suite in SUITES if config.suite == "all" else (config.suite,):
        with console.status(f"{suite}: walking up to speed") as status:
            figures = measure[suite](partial(_show, status, suite))
        rows += [{"subject": subject.name, **figure._asdict()} for figure in figures]
    cli.write_json(out, {"rows": rows, "provenance": cli.provenance(**asdict(config))})
    console.print(table(subject.name, rows))


def _show(status: Status, suite: str, over: int, walking: int) -> None:
    status.update(f"{suite}: {over} trials over, {walking} robots walking")


def table(title: str, rows: Sequence[dict[str, Any]]) -> Table:
    """The rows for reading."""
    shown = Table("quantity", "value", "unit", "n", title=title)
    for row in rows:
        shown.add_row(row["quantity"], f"{row['value']:.4g}", row["unit"], str(row["n"]))
    return shown


if __name__ == "__main__":
    cli.run(main, EvaluateConfig)
