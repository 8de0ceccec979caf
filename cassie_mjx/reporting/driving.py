"""What the suite `command` measured: a table of its quantities, maps of the errors, and the paths driven."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from cassie_mjx.reporting import drive_plots, page
from cassie_mjx.reporting.drive_plots import ErrorMap
from cassie_mjx.reporting.results import Result, blaming
from cassie_mjx.reporting.tables import NO_FIGURE, Row, Table, cell, sources

TEXT = (
    "How a policy follows commands: forward and lateral velocity and yaw rate, left positive, in the heading frame of "
    "the pelvis. The maps show the error of the mean velocity over the last 5 s of 10, the largest of all commands "
    "with a cell's two components, of robots that stay up; cells with falls are hatched and count them."
)
COMPONENTS = (("forward velocity", "m/s"), ("lateral velocity", "m/s"), ("yaw rate", "rad/s"))
SIDEWAYS = (2, 1)
"""The components that maps have beside the forward velocity."""


class Quantity(NamedTuple):
    """What the suite measures."""

    name: str
    meaning: str
    goal: str = NO_FIGURE
    digits: int = 2


GRID_ERROR_GOAL = 0.08
"""Of each component, m/s and rad/s."""
_GRID_ERROR = "error of the mean {} over the last 5 s, {}; mean over the grid's commands"
QUANTITIES = (
    Quantity("command_survived", "share of the grid, 118 commands x 4 phases of the stride, up for 10 s", "≥ 0.99", 3),
    *(
        Quantity(f"command_error_{name}", _GRID_ERROR.format(*component), f"≤ {GRID_ERROR_GOAL}", 3)
        for name, component in zip(("forward_mps", "lateral_mps", "yaw_radps"), COMPONENTS, strict=True)
    ),
    Quantity(
        "command_random_survived_60s",
        "share of 100 robots up for 60 s under a new command every 2 s, drawn as in training",
        "1",
    ),
    Quantity("turn_survived", "share that turns to the left by 360 degrees at 0.8 rad/s, from steps on the spot"),
    Quantity("turn_s", "time for that, s", digits=1),
    Quantity("figure_eight_survived", "share that completes two circles of 2 m radius at 0.7 m/s, a figure of eight"),
    Quantity("figure_eight_error_m", "largest distance from the figure, m", "≤ 0.3"),
    Quantity(
        "stop_survived", "share that stops from 2 m/s: mean speed over a stride below 0.1 m/s from then on, 2 s or more"
    ),
    Quantity("stop_s", "time for that, s", "≤ 2", 1),
    Quantity("sprint_survived", "share that gets from 0 to within 0.1 m/s of 2.8 m/s, by the mean over a stride"),
    Quantity("sprint_s", "time for that, s", digits=1),
    Quantity(
        "stand_survived_60s", "share that comes from 2 m/s to standing: up 60 s after the 3 s that it has for that", "1"
    ),
    Quantity(
        "stand_foot_slip_m", "farthest that a sole gets, along the ground, from where it was 3 s later, m", "≤ 0.02", 3
    ),
    Quantity("stand_torque_share", "mean torque of the motors from then on, over that of steps on the spot", "≤ 0.7"),
)


class Drives(NamedTuple):
    """How a policy followed C commands, T trials each, over its training seeds."""

    commands: np.ndarray
    """[C, 3], m/s and rad/s."""
    errors: np.ndarray
    """Of each component, mean over robots that stayed up, [C, 3], m/s and rad/s; NaN if none did."""
    fell: np.ndarray
    """[C, T], bool."""
    radius_m: float
    """Of the figure of eight."""
    paths: list[list[list[float]]]
    """Places of robots on the figure of eight, from its crossing on, [B, K, 2], m."""


def body(agents: Mapping[str, Sequence[Result]], folder: Path) -> str:
    """The table of these agents, each with its results of the suite, one a seed, and their maps and paths, in HTML."""
    shown = [each for name, results in agents.items() for each in drawings(name, read_drives(results, folder))]
    return page.table(quantities(agents, folder)) + page.drawn(shown)


def quantities(agents: Mapping[str, Sequence[Result]], folder: Path) -> Table:
    """What the suite measures, beside its goals: a column for each agent, and a sentence about its largest errors."""
    rows = []
    for name, meaning, goal, digits in QUANTITIES:
        row = Row(meaning, (name,), "command", digits=digits)
        rows.append((meaning, goal, *(cell(row, results) for results in agents.values()), name))
    notes = [largest_errors(name, read_drives(results, folder)) for name, results in agents.items()]
    if any(len(results) > 1 for results in agents.values()):
        notes.append("Interquartile mean over training seeds (least to greatest); errors by command are their mean.")
    notes += [f"{NO_FIGURE}: no goal, or no robot got there.", sources([r for each in agents.values() for r in each])]
    return Table(("what is measured", "goal", *(f"`{name}`" for name in agents), "quantity"), rows, notes)


def read_drives(results: Sequence[Result], folder: Path) -> Drives:
    """What the results of a policy, one a seed, hold together: mean errors, and the trials and paths of all."""
    drives: list[Drives] = []
    for result in results:
        with blaming(folder / result.name):
            cells, eight = result.content["command"], result.content["command"]["figure_eight"]
            commands = np.array(cells["commands"], float)
            errors = np.array([error or [np.nan] * len(COMPONENTS) for error in cells["errors"]], float)
            fell = np.array([[digit == "0" for digit in row] for row in cells["survived"]])
            if not commands.shape == errors.shape == (len(fell), len(COMPONENTS)):
                shapes = f"commands of shape {commands.shape} do not fit errors of shape {errors.shape}"
                raise ValueError(f"{shapes} and {len(fell)} of trials")
            drives.append(Drives(commands, errors, fell, float(eight["radius_m"]), eight["paths"]))
            if not np.array_equal(commands, drives[0].commands):
                raise ValueError("other commands than those of the first seed")
    errors = np.ma.masked_invalid([each.errors for each in drives]).mean(axis=0).filled(np.nan)
    fell = np.concatenate([each.fell for each in drives], axis=1)
    return drives[0]._replace(errors=errors, fell=fell, paths=[path for each in drives for path in each.paths])


def largest_errors(name: str, drives: Drives) -> str:
    """A sentence about the largest error of each component, and how many trials ended in a fall."""
    told = []
    if not np.isnan(drives.errors).all():
        worst = np.nanargmax(drives.errors, axis=0)
        for k, (component, unit) in enumerate(COMPONENTS):
            command = ",".join(f"{value:g}" for value in drives.commands[worst[k]])
            told.append(f"{drives.errors[worst[k], k]:.2f} {unit} in {component} under `command={command}`")
    falls = f"{drives.fell.sum()} of {drives.fell.size} trials of the grid end in a fall"
    return f"Largest errors of `{name}`: {', '.join(told) or NO_FIGURE}; {falls}."


def drawings(name: str, drives: Drives) -> list[tuple[Figure, str]]:
    """The maps of each component's error, to one scale a component, and the figure of eight, with captions."""
    shown = []
    for component, (error, unit) in enumerate(COMPONENTS):
        maps = [error_map(drives, component, sideways) for sideways in SIDEWAYS]
        highest = np.nanmax(drives.errors[:, component], initial=GRID_ERROR_GOAL)
        for cells, sideways in zip(maps, SIDEWAYS, strict=True):
            other, other_unit = COMPONENTS[sideways]
            figure = drive_plots.error_map(cells, f"{other}, {other_unit}", f"{error}, {unit}", highest)
            shown.append((figure, f"{name}: error of the {error} over forward velocity and {other}."))
    eight = drive_plots.figure_eight(drives.radius_m, drives.paths)
    return [*shown, (eight, f"{name}: figures of eight, {len(drives.paths)} robots; dashed: what they were to follow.")]


def error_map(drives: Drives, component: int, sideways: int) -> ErrorMap:
    """The largest error of a component over the forward velocity and another component of the command."""
    forward, other = (np.unique(drives.commands[:, axis]) for axis in (0, sideways))
    shape = len(forward), len(other)
    errors, fell, trials = np.full(shape, -np.inf), np.zeros(shape, int), np.zeros(shape, int)
    place = np.searchsorted(forward, drives.commands[:, 0]), np.searchsorted(other, drives.commands[:, sideways])
    np.fmax.at(errors, place, drives.errors[:, component])
    np.add.at(fell, place, drives.fell.sum(axis=1))
    np.add.at(trials, place, drives.fell.shape[1])
    return ErrorMap(forward, other, np.where(np.isfinite(errors), errors, np.nan), fell, trials)
