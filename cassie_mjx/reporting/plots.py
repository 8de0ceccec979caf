"""Plots of results, one pair of axes each, as SVG; no JAX, no MuJoCo. They are 5 inches wide, to be read on a phone."""

import io
import itertools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

# Okabe and Ito's colours, which colour-blind readers can tell apart.
COLOURS = {"compliant": "#e69f00", "stiff": "#009e73", "1x": "#0072b2", "1x-robust": "#cc79a7"}
SIDES = {"left": "#0072b2", "right": "#d55e00"}
OTHERS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f", "#8c564b", "#9467bd", "#17becf")
PAPER = "#b00020"
PALE_BLUES = ListedColormap(matplotlib.colormaps["Blues"](np.linspace(0, 0.6, 256)))

STYLE: dict[Any, Any] = {
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    # The same figure is the same file.
    "svg.hashsalt": "cassie-mjx",
}


class Series(NamedTuple):
    """How many robots of an agent stay up at each level of a disturbance."""

    label: str
    levels: Sequence[float]
    shares: Sequence[float]
    """Of its robots that stay up, 0 to 1."""


class PushMap(NamedTuple):
    """How many of an agent's robots survive a push."""

    shares: np.ndarray
    """[direction, force], 0 to 1."""
    directions_deg: Sequence[float]
    """From forward to the left."""
    forces_n: Sequence[float]
    """Evenly spaced."""

    @property
    def farthest_n(self) -> float:
        """The largest force that any robot survives, N."""
        return max(
            (force for force, column in zip(self.forces_n, self.shares.T, strict=True) if column.any()), default=0
        )


def svg(figure: Figure) -> str:
    """The figure as an SVG document."""
    text = io.StringIO()
    with matplotlib.rc_context(STYLE):
        figure.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()


@matplotlib.rc_context(STYLE)
def learning(runs: Sequence[Mapping[str, Any]], x: str, reward: str = "plain") -> Figure:
    """Return over "samples" or "train_s": for each variant the mean over its seeds, and from the least to the greatest.

    `runs` are those of a study (`experiments.learning`).
    """
    figure, axis = _axes(3.2)
    scale, unit = {"samples": (1e6, "million samples"), "train_s": (60, "minutes of training")}[x]
    names = list(dict.fromkeys(run["variant"] for run in runs))
    ends = []
    for name, colour in zip(names, itertools.cycle(OTHERS), strict=False):
        curves = [run["curve"] for run in runs if run["variant"] == name]
        # Where all seeds have a value, also when they took different times.
        grid = np.linspace(max(curve[x][0] for curve in curves), min(curve[x][-1] for curve in curves), 200)
        returns = np.array([np.interp(grid, curve[x], curve[f"return_{reward}"]) for curve in curves])
        axis.plot(grid / scale, returns.mean(axis=0), color=colour)
        axis.fill_between(grid / scale, returns.min(axis=0), returns.max(axis=0), color=colour, alpha=0.2, lw=0)
        ends.append((returns[:, -1].mean(), f"{name}, n = {len(curves)}", colour))
    if reward == "plain":
        axis.axhline(250, color=PAPER, lw=1, ls="--")
        end = {"xycoords": ("axes fraction", "data"), "ha": "right", "va": "top"}
        axis.annotate("paper: about 250", (0.99, 247), color=PAPER, **end)
    axis.set(xlabel=unit, ylabel=f"return of 300, {reward} reward", ylim=(0, 310), xlim=(0, None))
    _label_ends(figure, ends)
    return figure


@matplotlib.rc_context(STYLE)
def push_map(pushes: PushMap, reach_n: float) -> Figure:
    """Share of pushes survived, at least up to `reach_n`; the limits of the paper's policy dashed.

    Forward is up, left is on the left.
    """
    shares, directions_deg, forces_n = pushes
    radius = max(1.15 * reach_n, 200)
    figure = Figure(figsize=(5, 4.4), layout="constrained")
    axis = figure.add_subplot(projection="polar", theta_offset=np.pi / 2)
    half, step = np.pi / len(directions_deg), forces_n[1] - forces_n[0]
    angles = np.deg2rad([*directions_deg, directions_deg[0] + 360]) - half
    forces = np.append(np.subtract(forces_n, step / 2), forces_n[-1] + step / 2)
    mesh = axis.pcolormesh(angles, forces, shares.T, cmap=PALE_BLUES, vmin=0, vmax=1, edgecolors="face", lw=0.2)
    for degrees, limit in ((0, 140), (180, 90), (90, 50), (270, 50)):
        arc = np.deg2rad(degrees) + np.linspace(-2, 2, 30) * half
        axis.plot(arc, np.full(30, limit), "--", color=PAPER, lw=1.5)
        axis.annotate(f"{limit}", (arc[15], limit + 0.06 * radius), color=PAPER, ha="center", va="center")
    axis.set_thetagrids((0, 90, 180, 270), ("forward", "left", "backward", "right"))
    rings = np.arange(100, radius, 100)
    axis.set_rgrids(rings, [f"{ring:g} N" for ring in rings], angle=-45, color="0.25")
    axis.set(ylim=(0, radius))
    axis.grid(color="0.6", lw=0.4)
    figure.colorbar(mesh, ax=axis, shrink=0.7, label="share of pushes survived")
    return figure


@matplotlib.rc_context(STYLE)
def survival(series: Sequence[Series], xlabel: str, paper: Sequence[tuple[str, float]]) -> Figure:
    """A band for each agent, as high as the share of its robots that stay up; the paper's limits dashed."""
    figure, axis = _axes(0.9 + 0.55 * len(series))
    for place, (label, levels, shares) in enumerate(reversed(series)):
        colour = COLOURS.get(label, "0.4")
        axis.fill_between(levels, place, np.add(place, np.multiply(0.8, shares)), step="mid", color=colour, lw=0)
        axis.axhline(place, color="0.8", lw=0.5)
    for (name, level), side in zip(paper, ("right", "left"), strict=True):
        axis.axvline(level, color=PAPER, lw=1, ls="--")
        axis.annotate(name, (level, len(series)), color=PAPER, ha=side, va="bottom")
    axis.set_yticks(np.arange(len(series)) + 0.4, [label for label, *_ in reversed(series)])
    axis.tick_params("y", length=0)
    axis.set(xlabel=xlabel, xlim=(0, max(levels[-1] for _, levels, _ in series)), ylim=(0, len(series)))
    return figure


@matplotlib.rc_context(STYLE)
def joint(name: str, time_s: Sequence[float], curves: Mapping[str, Mapping[str, Sequence[float]]]) -> Figure:
    """Angle of a joint over a stride, of the left and the right leg, rad; the reference dashed."""
    figure, axis = _axes(2.4)
    ends = []
    for side, angles in curves.items():
        walked = np.rad2deg(angles["walked"])
        axis.plot(time_s, walked, color=SIDES[side])
        axis.plot(time_s, np.rad2deg(angles["reference"]), "--", color=SIDES[side], lw=1)
        ends.append((walked[-1], side, SIDES[side]))
    axis.set(xlabel="time, s", ylabel=f"{name}, degrees", xlim=(0, time_s[-1]))
    _label_ends(figure, ends)
    return figure


@matplotlib.rc_context(STYLE)
def feet(placements: Mapping[str, Mapping[str, Sequence[Sequence[float]]]]) -> Figure:
    """Where the feet stood, seen from above, m; the reference's as rings."""
    figure, axis = _axes(2.4)
    ends = []
    for side, places in placements.items():
        walked, reference = (np.array(places[name]).reshape(-1, 2) for name in ("walked", "reference"))
        axis.plot(*reference.T, "o", ms=10, mfc="none", mec=SIDES[side])
        axis.plot(*walked.T, "o", ms=4, color=SIDES[side])
        ends.append((walked[:, 1].mean(), side, SIDES[side]))
    axis.set(xlabel="along the walk, m", ylabel="to the left, m")
    axis.margins(0.08, 0.3)
    _label_ends(figure, ends)
    return figure


@matplotlib.rc_context(STYLE)
def ride(curve: Mapping[str, Sequence[float]]) -> Figure:
    """Speed over time of robots whose command changes: mean, and from the least to the greatest; the command dashed."""
    figure, axis = _axes(2.6)
    time = curve["time_s"]
    axis.plot(time, curve["commanded_mps"], "--", color="black", lw=1)
    if "mean_mps" in curve:
        axis.plot(time, curve["mean_mps"], color=COLOURS["1x"])
        axis.fill_between(time, curve["least_mps"], curve["greatest_mps"], color=COLOURS["1x"], alpha=0.2, lw=0)
    axis.set(xlabel="time, s", ylabel="speed over a stride, m/s")
    return figure


def _axes(height: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(5, height), layout="constrained")
    return figure, figure.subplots()


def _label_ends(figure: Figure, ends: Sequence[tuple[float, str, str]]) -> None:
    """Write (y, text, colour) on the right, at the height of the curves' ends but moved apart where they overlap."""
    axis = figure.axes[0]
    low, high = axis.get_ylim()
    line = 0.2 / figure.get_figheight() * (high - low)
    ends = sorted(ends)
    heights = [y for y, *_ in ends]
    for k in range(1, len(ends)):
        heights[k] = max(heights[k], heights[k - 1] + line)
    ceiling = high
    for k in reversed(range(len(ends))):
        heights[k] = min(heights[k], ceiling)
        ceiling = heights[k] - line
    for height, (_, text, colour) in zip(heights, ends, strict=True):
        axis.annotate(text, (1.01, height), xycoords=("axes fraction", "data"), color=colour, va="center")
