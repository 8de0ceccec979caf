"""A web page of the evaluation files in any folder."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from cassie_mjx.reporting import driving, page, plots
from cassie_mjx.reporting.results import Result, blaming, read
from cassie_mjx.reporting.tables import NO_FIGURE, ROWS, Table, cell, least, sources

INTRODUCTION = (
    "Beside the figures of Xie, Berseth, Clary, Hurst, van de Panne, Feedback Control For Cassie With Deep "
    "Reinforcement Learning (IROS 2018). Files, commands, hardware and dates stand under Sources."
)


def evaluations(folder: Path) -> tuple[list[Result], list[str]]:
    """The evaluation files in a folder and below, by name, and a sentence about each JSON file that is none."""
    found, skipped = [], []
    for path in sorted(folder.rglob("*.json")):
        name = path.relative_to(folder).as_posix()
        if not path.is_file() or any(part.startswith(".") for part in path.relative_to(folder).parts):
            continue
        try:
            result = read(folder, name)
            with blaming(path):
                if not any({"agent", "quantity", "value"} <= row.keys() for row in result.content["rows"]):
                    raise ValueError("its rows name no quantity of an agent")
            found.append(result)
        except ValueError as error:
            skipped.append(str(error))
    return found, skipped


def by_agent(results: Sequence[Result]) -> dict[str, list[Result]]:
    """The results of each agent on each engine, seeds together; a file of several counts with its own rows."""
    agents: dict[str, list[Result]] = {}
    for result in results:
        rows = [row for row in result.content["rows"] if {"agent", "quantity", "value"} <= row.keys()]
        for name in dict.fromkeys(row["agent"] for row in rows):
            own = [row for row in rows if row["agent"] == name]
            engine = " on MJX" if result.provenance.get("physics") == "mjx" else ""
            engine += " with electronics" if result.provenance.get("electronics") else ""
            agents.setdefault(re.sub(r"-seed\d+$", "", name) + engine, []).append(
                Result(result.name, result.content | {"rows": own})
            )
    return agents


def beside_the_paper(agents: Mapping[str, Sequence[Result]]) -> Table:
    """The paper's experiments that one of the agents has been through; several files of an agent are a mean."""
    header = (
        "2 kHz; MuJoCo C unless said",
        "paper: controller",
        "paper: policy",
        *(f"`{name}`" for name in agents),
        "command",
    )
    # A file without any of the paper's figures is no seed of its agent.
    seeds = [
        [result for result in results if any(least(result, row.quantities) is not None for row in ROWS)]
        for results in agents.values()
    ]
    rows = []
    for row in ROWS:
        cells = [cell(row, results) for results in seeds]
        if set(cells) - {NO_FIGURE}:
            rows.append((row.experiment, row.paper_controller, row.paper_policy, *cells, f"suite={row.suite}"))
    files = {result.name: result for results in agents.values() for result in results}
    return Table(header, rows, [sources(list(files.values()), "")])


def every_quantity(agents: Mapping[str, Sequence[Result]]) -> Table:
    """Every quantity of every agent: the mean over its files."""
    units = {
        row["quantity"]: row.get("unit", "")
        for results in agents.values()
        for result in results
        for row in result.content["rows"]
    }
    rows = []
    for quantity, unit in units.items():
        values = [[v for result in results for v in result.values(quantity)] for results in agents.values()]
        rows.append((quantity, *(f"{np.mean(each):.5g}" if each else NO_FIGURE for each in values), unit))
    return Table(("quantity", *agents, "unit"), rows, [])


def push_maps(results: Sequence[Result]) -> str:
    """The push map of each file that has one, all to the same scale."""
    maps = []
    for result in results:
        if "map" in result.content:
            with blaming(Path(result.name)):
                cells = result.content["map"]
                survived = np.array([[[int(digit) for digit in row] for row in phases] for phases in cells["survived"]])
                shown = plots.PushMap(survived.mean(axis=1), cells["directions_deg"], cells["forces_N"])
                maps.append((shown, f"{result.content['rows'][0]['agent']}, {result.name}."))
    reach_n = max((shown.farthest_n for shown, _ in maps), default=0)
    return page.drawn([(plots.push_map(shown, reach_n), caption) for shown, caption in maps])


def folder_page(results: Sequence[Result]) -> str:
    """The web page."""
    agents = by_agent(results)
    compared = page.table(beside_the_paper(agents))
    compared += f"<details><summary>Every quantity</summary>{page.table(every_quantity(agents))}</details>"
    sections = [page.section("Beside the paper", "A column for each agent.", compared, results)]
    drives = {name: [result for result in found if "command" in result.content] for name, found in agents.items()}
    if drives := {name: found for name, found in drives.items() if found}:
        used = [result for found in drives.values() for result in found]
        sections.append(page.section("Driving", driving.TEXT, driving.body(drives, Path()), used))
    if maps := push_maps(results):
        text = "Share of the phases of the stride at which a push of 0.2 s was survived. Dashed: the paper's limits, N."
        sections.append(page.section("Pushes from all sides", text, maps, results))
    return page.document("Cassie MJX: evaluations", INTRODUCTION, sections)
