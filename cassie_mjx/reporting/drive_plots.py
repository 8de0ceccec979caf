"""Plots of how a policy follows commands, seen as its driver sees it: forward is up, left is on the left."""

from collections.abc import Sequence
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from cassie_mjx.reporting.plots import OTHERS, PALE_BLUES, PAPER, STYLE


class ErrorMap(NamedTuple):
    """The error of one component of the velocity over two components of the command, F x S of them."""

    forward_mps: np.ndarray
    """[F], rising."""
    sideways: np.ndarray
    """The other component, [S], rising."""
    errors: np.ndarray
    """The largest of each cell's commands, [F, S]; NaN where no robot stayed up, or nothing was commanded."""
    fell: np.ndarray
    """Trials that ended in a fall, [F, S]."""
    trials: np.ndarray
    """[F, S]; 0 where nothing was commanded."""


@matplotlib.rc_context(STYLE)
def error_map(cells: ErrorMap, sideways: str, error: str, highest: float) -> Figure:
    """A cell for each pair of components of the command, with its error; cells with falls are hatched and count them.

    Args:
      cells: what to draw.
      sideways: what the horizontal axis is, with its unit.
      error: what is off, with its unit.
      highest: the error of the darkest colour.
    """
    figure = Figure(figsize=(5, 4), layout="constrained")
    axis = figure.subplots()
    blues = PALE_BLUES.with_extremes(bad="white")
    axis.pcolormesh(np.ma.masked_invalid(cells.errors), cmap=blues, vmin=0, vmax=highest, ec="white", lw=1)
    for row, column in np.argwhere(cells.trials):
        _write_cell(axis, row, column, cells)
    axis.set_xticks(np.arange(len(cells.sideways)) + 0.5, [f"{value:g}" for value in cells.sideways])
    axis.set_yticks(np.arange(len(cells.forward_mps)) + 0.5, [f"{value:g}" for value in cells.forward_mps])
    axis.tick_params(length=0)
    axis.set(xlabel=f"commanded {sideways}, left positive", ylabel="commanded forward velocity, m/s")
    axis.set_title(f"error of the {error}", size=10, loc="left")
    axis.invert_xaxis()
    axis.spines[:].set_visible(False)
    return figure


def _write_cell(axis: Axes, row: int, column: int, cells: ErrorMap) -> None:
    error, fell, trials = (part[row, column] for part in (cells.errors, cells.fell, cells.trials))
    lines, box = [] if np.isnan(error) else [f"{error:.2f}"], {}
    if fell:
        axis.add_patch(Rectangle((column, row), 1, 1, fill=False, hatch="///", ec=PAPER, lw=0))
        lines.append("all fell" if fell == trials else f"{fell} of {trials} fell")
        box = {"bbox": {"fc": "white", "ec": "none", "pad": 1.5}, "size": 8}
    axis.annotate("\n".join(lines), (column + 0.5, row + 0.5), ha="center", va="center", **box)


@matplotlib.rc_context(STYLE)
def figure_eight(radius_m: float, paths: Sequence[Sequence[Sequence[float]]]) -> Figure:
    """Paths [B, K, 2], m, of robots from the origin on, and the figure dashed; a cross where a robot fell.

    A robot has fallen if the last two places of its path are the same.
    """
    figure = Figure(figsize=(5, 3.3), layout="constrained")
    axis = figure.subplots()
    for side in (1, -1):
        figure_style = {"fill": False, "ls": "--", "lw": 1.5, "ec": "black", "zorder": 3}
        axis.add_patch(Circle((side * radius_m, 0), radius_m, **figure_style))
    for path in map(np.asarray, paths):
        axis.plot(path[:, 1], path[:, 0], color=OTHERS[0], lw=1, alpha=0.7)
        if (path[-1] == path[-2]).all():
            axis.plot(*path[-1, ::-1], "x", color=PAPER, ms=9, mew=2, zorder=4)
    axis.plot(0, 0, "o", color="black", ms=4, zorder=4)
    axis.set(xlabel="to the left of the start, m", ylabel="ahead of the start, m", aspect="equal")
    axis.invert_xaxis()
    return figure
