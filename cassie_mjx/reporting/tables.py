"""What result files say, as tables beside the paper's figures."""

import textwrap
from collections.abc import Sequence
from typing import NamedTuple

from cassie_mjx.reporting.results import Result
from cassie_mjx.reporting.spread import spread

NO_FIGURE = "–"


class Row(NamedTuple):
    """An experiment whose figure is the least of some quantities of an evaluation."""

    experiment: str
    quantities: tuple[str, ...]
    suite: str
    paper_controller: str = NO_FIGURE
    paper_policy: str = NO_FIGURE
    digits: int = 0
    highest: float = float("inf")
    """The highest level tried, of files that do not say it: a limit that reaches it may be larger."""


# Paper: Xie et al. (IROS 2018), section V. It pushed "sideways" and names no phase of the stride.
ROWS = (
    Row("undisturbed return, plain reward, of 300", ("return_plain",), "walk", NO_FIGURE, "about 250", 1),
    Row("speed, m/s", ("speed_mps",), "walk", digits=3),
    Row("ten walks of 60 s: the shortest, s", ("survived_s_60s",), "walk long=true", digits=1),
    Row("return with senses 5 ms late", ("delay_5ms_return_plain",), "delay", NO_FIGURE, "247", 1),
    Row("return with senses 10 ms late", ("delay_10ms_return_plain",), "delay", NO_FIGURE, "falls", 1),
    Row("largest delay, ms", ("delay_max_ms",), "delay", NO_FIGURE, "5, not 10", 1, 20),
    Row("terrain z = h sin x, largest h, m", ("terrain_h_m",), "terrain", "0.07", "0.15", 2, 0.4),
    Row("terrain, largest h over 60 s, m", ("terrain_h_m_60s",), "terrain long=true", digits=2, highest=0.4),
    *(
        Row(f"push {way}, {phase} phase, N", tuple(quantities), "push", controller, policy, 0, 400)
        for way, sides, controller, policy in (
            ("forward", ("forward",), "50", "140"),
            ("backward", ("backward",), "70", "90"),
            ("sideways", ("left", "right"), "15", "50"),
        )
        for phase, quantities in (
            ("median", [f"push_{side}_median_N" for side in sides]),
            ("worst", [f"push_{side}_N" for side in sides]),
        )
    ),
)


class Table(NamedTuple):
    """Rows of text; the last cell of each is code."""

    header: tuple[str, ...]
    rows: list[tuple[str, ...]]
    notes: list[str]


def least(result: Result, quantities: Sequence[str]) -> float | None:
    """The least of some quantities; None unless all were measured."""
    values = [result.value(quantity) for quantity in quantities]
    return None if None in values else min(value for value in values if value is not None)


def cell(row: Row, results: Sequence[Result]) -> str:
    """The interquartile mean over the results, one a seed, and the least and greatest of them."""
    measured = [(value, result) for result in results if (value := least(result, row.quantities)) is not None]
    if not measured:
        return NO_FIGURE
    values = [value for value, _ in measured]
    text = span(values, row.digits)
    text += f" ({len(values)} of {len(results)} seeds)" if len(values) < len(results) else ""
    tried = [result.provenance.get("highest", {}).get(row.quantities[0], row.highest) for _, result in measured]
    ends = sum(value >= highest for value, highest in zip(values, tried, strict=True))
    text += ", the highest tried" if ends else ""
    return text + (f" by {ends} of them" if 0 < ends < len(values) else "")


def span(values: Sequence[float], digits: int) -> str:
    """The interquartile mean; unless all values are alike, its interval if known, and the least and greatest."""
    found = spread(values)
    mean, low, high = (f"{value:.{digits}f}" for value in (found.iqm, found.least, found.greatest))
    sure = "" if found.interval is None else " [{:.{d}f}, {:.{d}f}]".format(*found.interval, d=digits)
    return mean if low == high else f"{mean}{sure} ({low} to {high})"


def sources(results: Sequence[Result], folder: str = " in `experiments/results`") -> str:
    """Files, hardware and dates in one sentence."""
    if not results:
        return "No result file yet."
    files = ", ".join(f"`{result.name}`" for result in results)
    hardware = ", ".join(sorted({result.provenance["hardware"] for result in results}))
    dates = sorted({result.provenance["date"] for result in results})
    return f"From {files}{folder}; {hardware}; {' to '.join(dict.fromkeys((dates[0], dates[-1])))}."


def markdown(table: Table) -> str:
    """The table, and its notes in lines of at most 120 characters, in Markdown."""
    lines = [table.header, ("---",) * len(table.header)]
    lines += [(*row[:-1], f"`{row[-1]}`") for row in table.rows]
    text = "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)
    notes = [textwrap.fill(note, 120, break_long_words=False, break_on_hyphens=False) for note in table.notes]
    return "\n\n".join([text, *notes])
