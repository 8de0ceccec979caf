"""The tables of README.md, docs/results.md and docs/evaluate.md, between two markers of each."""

from pathlib import Path

from cassie_mjx.reporting import driving
from cassie_mjx.reporting.tables import markdown
from experiments import tables

MARKERS = ("<!-- results, written by `make report` -->", "<!-- end of results -->")


def readme_block(folder: Path) -> str:
    """What stands between the markers of the README."""
    return markdown(tables.summary(folder))


def block(folder: Path) -> str:
    """What stands between the markers of the page of all results."""
    found = [
        tables.beside_the_paper(folder),
        tables.speeds_and_blends(folder),
        tables.beside_each_other(folder, tables.ALL_SPEEDS),
        tables.beside_each_other(folder, tables.STEPS),
    ]
    return "\n\n".join(markdown(content) for content in found if content)


def driving_block(folder: Path) -> str:
    """What stands between the markers of the page that explains commands."""
    return markdown(driving.quantities(dict(tables.matching(folder, tables.DRIVEN)), folder))


def with_block(text: str, content: str) -> str:
    """A page with `content` between its markers.

    Raises:
      ValueError: it has no two markers, each once, in order.
    """
    start, end = MARKERS
    before, found, rest = text.partition(start)
    _, closed, after = rest.partition(end)
    if not found or not closed or start in after or end in after:
        raise ValueError(f"The file for the table needs the lines {start} and {end}, once each and in this order.")
    return f"{before}{start}\n\n{content}\n\n{end}{after}"
