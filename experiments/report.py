"""What has been measured, as one web page and in the README: `python -m experiments.report out=report/index.html`.

With `readme=README.md`, `page=docs/results.md` and `drives=docs/evaluate.md` the tables between the two markers of
these files are written anew. Everything comes from `experiments/results`; what has no result file yet is said to have
none. Imports neither JAX nor MuJoCo.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cassie_mjx import cli
from cassie_mjx.configuration.values import Checked
from cassie_mjx.reporting import driving, page, plots
from cassie_mjx.reporting.page import drawn, section, table
from cassie_mjx.reporting.results import Result, blaming, find
from cassie_mjx.reporting.tables import NO_FIGURE, Table
from experiments import tables
from experiments.pages import block, driving_block, readme_block, with_block
from experiments.tables import agents

STUDIES = {
    "walking": "Learning to walk",
    "make_train": "The same on two quiet cores",
    "learning_speeds": "Learning other speeds",
    "starts": "Starting up to 1.2 m/s off the reference's velocity, and at it",
    "changes": "The beginning of a run, with one change of the default at a time",
    "robust": "Learning under pushes, terrain and delay, and going on with less noise",
    "symmetry": "Learning under disturbances: one step of the stride, the other as in a mirror, and both",
    "paper": "The paper's learner as printed, and readings that differ in one point",
}
"""Studies of `experiments.learning`, and what they are about."""


@dataclass(frozen=True)
class ReportConfig(Checked):
    """Where from, and where to."""

    results: str = "experiments/results"
    """Folder of the result files."""
    out: str = "report/index.html"
    """The web page; a folder that is missing is made."""
    readme: str = ""
    """Markdown file whose text between the two markers is to be the table of the README; none if empty."""
    page: str = ""
    """Markdown file whose text between the two markers is to be all tables but that of driving; none if empty."""
    drives: str = ""
    """Markdown file whose text between the two markers is to be the table of driving; none if empty."""
    overwrite: bool = False
    """Whether to replace a file that is no report of ours, in place of the web page."""


INTRODUCTION = (
    "Paper: Xie, Berseth, Clary, Hurst, van de Panne, Feedback Control For Cassie With Deep Reinforcement Learning "
    "(IROS 2018). Figures of ours were measured in MuJoCo C at 2 kHz with deterministic policies unless said "
    "otherwise. Files, commands, hardware and dates stand under Sources."
)

DEFINITIONS = (
    "A fall is a pelvis lower than 0.6 m or higher than 1.2 m over the ground. Returns are means over 10 starting "
    "phases of 300 steps. A push lasts 0.2 s; its limit is the largest force, in 10 N steps, for which it and every "
    "smaller one was survived for 4 s, at the worst and in the median of 8 phases of the stride; sideways is the "
    "weaker side. Heights h and delays are survived for 10 s from 8 and 10 phases. Training measures its policies from "
    "the phases k/10 of the stride, k = 0 to 9, and keeps the best by them; what is reported begins halfway between "
    "two such phases, at (k + 1/2)/10, or (k + 1/2)/8 where there are eight, unless a table says otherwise. Learning "
    "curves are of training's phases. What a study says of a run is about its last policy; of runs before 2026-11-27, "
    "its best."
)


def whole_page(folder: Path) -> str:
    """The web page, which needs no other file."""
    sections = [compared(folder), driven(folder), *learned(folder), pushed(folder), survived(folder), strode(folder)]
    sections += [sped(folder), *variants_compared(folder), *walked_twice(folder)]
    return page.document("Cassie MJX: what has been measured", INTRODUCTION, sections)


def compared(folder: Path) -> str:
    """The tables beside the paper's, and every figure of every seed."""
    results = [result for _, found in agents(folder) for result in found]
    parts = [table(tables.beside_the_paper(folder))]
    if results:
        parts.append(f"<details><summary>Every figure of every agent</summary>{table(all_figures(results))}</details>")
    return section("Beside the paper", DEFINITIONS, "".join(parts), results)


def all_figures(results: Sequence[Result]) -> Table:
    """Every quantity of these evaluations, a column each."""
    units = {row["quantity"]: row["unit"] for result in results for row in result.content["rows"]}
    rows = []
    for quantity, unit in units.items():
        values = [result.value(quantity) for result in results]
        cells = [NO_FIGURE if value is None else f"{value:.5g}" for value in values]
        rows.append((quantity, *cells, unit))
    return Table(("quantity", *(result.name for result in results), "unit"), rows, [])


def driven(folder: Path) -> str:
    """How policies follow commands."""
    found = dict(tables.matching(folder, tables.DRIVEN))
    body = driving.body(found, folder) if found else ""
    out = "experiments/results/command/joystick-seed0.json"
    command = f"python -m cassie_mjx.evaluate policy=joystick suite=command out={out}"
    return section("Driving", driving.TEXT, body, [r for results in found.values() for r in results], command)


def learned(folder: Path) -> list[str]:
    """Learning curves by samples, and those of the walk by time."""
    sections = []
    for study, title in STUDIES.items():
        shown, found = [], find(folder, f"{study}.json")
        for result in found:
            with blaming(folder / result.name):
                runs = result.content["runs"]
                shown.append((plots.learning(runs, "samples"), "Plain return over samples."))
                shown.append((plots.learning(runs, "samples", "weighted"), "Weighted return over samples."))
                if study == "walking":
                    shown.append((plots.learning(runs, "train_s"), "Plain return over the time of training."))
        text = "Mean over n training seeds; shaded from the least to the greatest."
        command = f"python -m experiments.learning study={study} out=experiments/results/{study}.json"
        sections.append(section(title, text, drawn(shown), found, command))
    return sections


def pushed(folder: Path) -> str:
    """Polar maps of pushes survived, all to the same scale."""
    found = agents(folder, "map")
    maps = [(agent, len(results), mean_map(folder, results)) for agent, results in found]
    reach_n = max((shares.farthest_n for *_, shares in maps), default=0)
    shown = [(plots.push_map(shares, reach_n), f"{agent}, n = {n}.") for agent, n, shares in maps]
    text = "Share of 8 phases at which a push was survived, mean over n policies. Dashed: the limits of the paper's, N."
    command = "python -m cassie_mjx.evaluate policy=1x suite=map out=experiments/results/map/1x-seed0.json"
    return section("Pushes from all sides", text, drawn(shown), [r for _, results in found for r in results], command)


def mean_map(folder: Path, results: Sequence[Result]) -> plots.PushMap:
    """The mean over results, one a seed, of the share of phases at which each push was survived."""
    maps = []
    for result in results:
        with blaming(folder / result.name):
            cells = result.content["map"]
            survived = np.array([[[int(digit) for digit in row] for row in phases] for phases in cells["survived"]])
            if survived.shape != tuple(len(cells[axis]) for axis in ("directions_deg", "phases", "forces_N")):
                raise ValueError(f"a map of shape {survived.shape} does not fit its axes")
            maps.append(plots.PushMap(survived.mean(axis=1), cells["directions_deg"], cells["forces_N"]))
            if maps[-1][1:] != maps[0][1:]:
                raise ValueError("a map with other directions or forces than that of the first seed")
    return maps[0]._replace(shares=np.mean([one.shares for one in maps], axis=0))


def survived(folder: Path) -> str:
    """Share of robots that stay up over the height of the terrain, and over the delay of the senses."""
    found = agents(folder, "survival")
    shown = []
    for quantity, label, paper in (
        ("terrain_survived", "height h of the terrain z = h sin x, m", [("paper: controller", 0.07), ("policy", 0.15)]),
        ("delay_survived", "age of what policy and PD loop see, ms", [("paper: walks", 5), ("falls", 10)]),
    ):
        series = [survival_series(folder, agent, results, quantity) for agent, results in found]
        if series:
            shown.append((plots.survival(series, label, paper), "Height of a band: share of the starts up after 10 s."))
    text = (
        "Blind over terrain, and with old senses: the share of starting phases from which an agent stays up for 10 s."
    )
    command = "python -m experiments.survival policy=1x out=experiments/results/survival/1x-seed0.json"
    return section("Terrain and delay", text, drawn(shown), [r for _, results in found for r in results], command)


def survival_series(folder: Path, agent: str, results: Sequence[Result], quantity: str) -> plots.Series:
    """The mean over results, one a seed, of the shares that stay up at each level."""
    levels, shares = [], []
    for result in results:
        with blaming(folder / result.name):
            cells = [row for row in result.content["rows"] if row["quantity"] == quantity]
            if not cells:
                raise ValueError(f"no rows of {quantity}")
            levels.append([row["level"] for row in cells])
            shares.append([row["value"] for row in cells])
            if levels[-1] != levels[0]:
                raise ValueError(f"{quantity} at other levels than those of the first seed")
    return plots.Series(agent, levels[0], np.mean(shares, axis=0).tolist())


def strode(folder: Path) -> str:
    """A policy's stride beside the reference's."""
    shown, sources = [], find(folder, "stride_*.json")
    for result in sources:
        with blaming(folder / result.name):
            name = result.name.removeprefix("stride_").removesuffix(".json")
            for joint, curves in result.content["joints"].items():
                shown.append((plots.joint(joint, result.content["time_s"], curves), f"{name}: {joint}."))
            shown.append((plots.feet(result.content["feet"]), f"{name}: where the feet stood."))
    text = (
        "Joint angles over one stride of steady walking, and the places of the feet. Dashed and rings: the reference."
    )
    command = "python -m experiments.stride policy=1x out=experiments/results/stride_1x.json"
    return section("The stride", text, drawn(shown), sources, command)


def sped(folder: Path) -> str:
    """Other speeds, and blends of policies."""
    shown, sources = [], [*find(folder, "speeds.json"), *find(folder, "interpolation.json")]
    for result in sources:
        with blaming(folder / result.name):
            rides, profile = (result.content.get(name) for name in ("rides", "profile"))
            curves = rides or ({"profile": profile} if profile else {})
            caption = "{}: speed; the command dashed; shaded from the least to the greatest of the robots up."
            shown += [(plots.ride(curve), caption.format(name)) for name, curve in curves.items()]
    compared = tables.speeds_and_blends(folder)
    body = (table(compared) if compared else "") + drawn(shown)
    command = "python -m experiments.speeds out=experiments/results/speeds.json"
    return section("Speeds and blends", "Policies for other speeds, and changing between them.", body, sources, command)


def variants_compared(folder: Path) -> list[str]:
    """Policies side by side in the paper's experiments."""
    sections = []
    for title, text, patterns, arguments in (
        (
            "One policy for all speeds",
            "One policy with a commanded speed, beside policies that were trained at one.",
            tables.ALL_SPEEDS,
            "policy=any speed=2x suite=all out=experiments/results/evaluate/any-2x-seed0.json",
        ),
        (
            "One step or both",
            "The first stage of the robust training, of one step of the stride, the other being its mirror image, and "
            "of both.",
            tables.STEPS,
            "policy=runs/studies/1x-robust-first-seed0 suite=push "
            "out=experiments/results/evaluate/1x-robust-first-seed0.json",
        ),
    ):
        found = tables.beside_each_other(folder, patterns)
        results = [result for _, results in tables.matching(folder, patterns) for result in results] if found else []
        command = f"python -m cassie_mjx.evaluate {arguments}"
        sections.append(section(title, text, table(found) if found else "", results, command))
    return sections


def walked_twice(folder: Path) -> list[str]:
    """The same trials and the same policies on both engines."""
    sections = []
    for name, title, text, content, arguments in (
        (
            "verdicts",
            "The same trials on both engines",
            "MuJoCo C and MJX at 2 kHz with the same contacts, from the same states; on MJX, terrain is a tangent "
            "plane under each leg. A verdict is whether a trial was survived; it is at a limit if the next weaker or "
            "stronger disturbance has another.",
            tables.verdicts,
            "policy=1x",
        ),
        (
            "engines",
            "The engine trained on, and the other",
            "Returns on the engines as they train: MJX with the feet's contacts alone and fewer solver iterations.",
            tables.engines,
            "runs=runs/1x-seed0",
        ),
    ):
        body, found = "", find(folder, f"{name}.json")
        for result in found:
            with blaming(folder / result.name):
                body += table(content(result))
        command = f"python -m experiments.{name} {arguments} out=experiments/results/{name}.json"
        sections.append(section(title, text, body, found, command))
    return sections


def main(config: ReportConfig) -> None:
    """Write the page, and the tables of the files that are named."""
    folder = Path(config.results)
    if not folder.is_dir():
        raise ValueError(f"results={folder} is not a folder; name the one with the result files.")
    Path(config.out).parent.mkdir(exist_ok=True)
    paths = {config.out: cli.check_output(config.out, page.REPORT, config.overwrite)}
    texts = {config.out: whole_page(folder)}
    for name, content in ((config.readme, readme_block), (config.page, block), (config.drives, driving_block)):
        if name:
            paths[name] = cli.check_writable(name)
            texts[name] = with_block(paths[name].read_text(), content(folder))
    for name, text in texts.items():
        cli.write_text(paths[name], text)
        cli.console().print(f"{name}, {len(text) / 1e3:.0f} kB", soft_wrap=True)


if __name__ == "__main__":
    cli.run(main, ReportConfig)
