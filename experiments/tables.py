"""Result files read back, and what they say as tables beside the paper's figures; no JAX, no MuJoCo."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cassie_mjx.reporting.results import Result, blaming, find
from cassie_mjx.reporting.spread import FEWEST
from cassie_mjx.reporting.tables import NO_FIGURE, ROWS, Row, Table, cell, sources, span

WALK_S = 10.0
EVALUATE = "`python -m cassie_mjx.evaluate policy=NAME`, or `policy=runs/studies/NAME-seed1` for seed 1,"
RETURNS = "`policy=controller:NAME` is a controller; it imitates nothing, so it has no return."


AGENTS = {
    "compliant": "controller_compliant.json",
    "stiff": "controller_stiff.json",
    "1x": "evaluate/1x-seed*.json",
    "1x-exact-starts": "evaluate/1x-exact-starts-seed*.json",
    "1x-robust": "evaluate/1x-robust-seed*.json",
}
"""Our agents, and the glob pattern of their evaluations: a policy has one for each seed that it was trained with."""


ALL_SPEEDS = {
    "1x": AGENTS["1x"],
    "any speed=1x": "evaluate/any-1x-seed*.json",
    "2x": "evaluate/2x-seed*.json",
    "any speed=2x": "evaluate/any-2x-seed*.json",
}
"""The same for the policy of all speeds beside those of one."""
STEPS = {
    "1x-robust-first": "evaluate/1x-robust-first-seed*.json",
    "1x-robust-first-both-steps": "evaluate/1x-robust-first-both-steps-seed*.json",
}
"""The same for policies that learned one step of the stride, the other being its mirror image, beside those of both."""


DRIVEN = {"joystick": "command/joystick-seed*.json"}
"""The same for policies that follow commands, and the results of the suite `command`."""


def agents(folder: Path, measurement: str = "") -> list[tuple[str, list[Result]]]:
    """The agents that have been evaluated or, if one is named, been through another measurement, with the results.

    Those of other measurements have the names of the evaluations, in a folder of the measurement's name.
    """
    return matching(folder, {w: f"{measurement}/{Path(p).name}" if measurement else p for w, p in AGENTS.items()})


def matching(folder: Path, patterns: Mapping[str, str]) -> list[tuple[str, list[Result]]]:
    """The results that match each agent's glob pattern, of those agents that have any."""
    found = [(agent, find(folder, pattern)) for agent, pattern in patterns.items()]
    for agent, results in found:
        for result in results:
            with blaming(folder / result.name):
                _check_origin(agent, result.seed, result.provenance)
    return [(agent, results) for agent, results in found if results]


def _check_origin(agent: str, seed: str, provenance: dict[str, Any]) -> None:
    """Raise ValueError unless an agent's result is of MuJoCo C, of its speed, and of the seed in the file's name."""
    found = {"physics": "native", "speed": None, "seed": seed} | provenance | provenance.get("agent", {})
    wanted = {"physics": "native", "speed": agent.partition(" speed=")[2] or None, "seed": seed}
    for key, value in wanted.items():
        if str(found[key]) != str(value):
            raise ValueError(f"it is of {key}={found[key]}, where {key}={value} is reported")


ENGINES = {"native": "MuJoCo C", "mjx": "MJX"}
"""The engines' names in result files, and to readers."""

PAPER_SPEEDS = dict.fromkeys(("0x", "2x", "3x"), "learned in 3 to 5 h") | {"4x": "learned, unstable in training"}
PAPER_BLENDS = {"1x,2x schedule=ramp": "speeds up, slows down", "2x,3x schedule=ramp": "speeds up, slows down"}
PAPER_BLENDS |= {"1x,2x schedule=adaptive": "h = 0.22 m"}


def beside_the_paper(folder: Path) -> Table:
    """The paper's experiments with one agent; those that nothing of ours has been through yet stand in the notes."""
    measured = agents(folder)
    header = ("MuJoCo C, 2 kHz", "paper: controller", "paper: policy", *_headings(measured), "command")
    cells = _cells(measured)
    missing = [f"`{agent}`" for agent in AGENTS if agent not in dict(measured)]
    missing += [row.experiment for row in ROWS if row not in cells]
    rows = [
        (row.experiment, row.paper_controller, row.paper_policy, *values, f"suite={row.suite}")
        for row, values in cells.items()
    ]
    notes = [f"By {EVALUATE} with the row's argument. {RETURNS}{_best(measured)}"]
    notes += [f"Not measured yet: {'; '.join(missing)}."] if missing else []
    results = [r for _, found in measured for r in found]
    return Table(header, rows, [*notes, *_former_phases(results), sources(results)])


SUMMARY = (
    "undisturbed return, plain reward, of 300",
    "return with senses 5 ms late",
    "largest delay, ms",
    "terrain z = h sin x, largest h, m",
    "push forward, worst phase, N",
    "push backward, worst phase, N",
    "push sideways, worst phase, N",
)
"""The rows of the README's table."""


def summary(folder: Path) -> Table:
    """The best known experiments of the paper, beside the controller that bears most and the policies."""
    measured = [each for each in agents(folder) if each[0] in ("stiff", "1x", "1x-robust")]
    names = (f"`{agent}`" + (f", {len(found)} seeds" if len(found) > 1 else "") for agent, found in measured)
    header = ("", "paper: controller", "paper: policy", *names, "`evaluate`")
    rows = [
        (row.experiment, row.paper_controller, row.paper_policy, *values, f"suite={row.suite}")
        for row, values in _cells(measured).items()
        if row.experiment in SUMMARY
    ]
    most = max((len(results) for _, results in measured), default=0)
    interval = f" [95% interval, from {FEWEST} seeds on]" if most >= FEWEST else ""
    note = (
        f"MuJoCo C at 2 kHz; policies: interquartile mean over training seeds{interval} (least to greatest). "
        "`stiff` is hand-made."
    )
    return Table(header, rows, [note])


def beside_each_other(folder: Path, patterns: Mapping[str, str]) -> Table | None:
    """Agents in the paper's experiments; None unless two have results, one of them beyond the `AGENTS`."""
    found = matching(folder, patterns)
    if len(found) < 2 or {agent for agent, _ in found} <= AGENTS.keys():
        return None
    rows = [(row.experiment, *values, f"suite={row.suite}") for row, values in _cells(found).items()]
    told = " and, for `any`, the column's" if any(" speed=" in agent for agent, _ in found) else ""
    note = f"By {EVALUATE} with the row's argument{told}."
    header = ("MuJoCo C, 2 kHz", *_headings(found), "command")
    results = [r for _, of_agent in found for r in of_agent]
    return Table(header, rows, [note, *_former_phases(results), sources(results)])


def _former_phases(results: Sequence[Result]) -> list[str]:
    """A note about results that were measured from the phases that training measures from, if there are any."""
    former = [f"`{result.name}`" for result in results if "phases" not in result.provenance]
    return [f"From the phases k/10 and k/8, by which policies were chosen: {', '.join(former)}."] if former else []


def _cells(measured: Sequence[tuple[str, list[Result]]]) -> dict[Row, list[str]]:
    """What each agent did in each of `ROWS` that any of them has been through."""
    found = {row: [cell(row, results) for _, results in measured] for row in ROWS}
    return {row: cells for row, cells in found.items() if set(cells) - {NO_FIGURE}}


def _headings(measured: Sequence[tuple[str, list[Result]]]) -> list[str]:
    return [f"`{agent}`{_seeds(results)}" for agent, results in measured]


def _seeds(results: Sequence[Result]) -> str:
    seeds = [result.seed for result in results if result.seed]
    if len(seeds) == 1:
        return f", training seed {seeds[0]}"
    interval = " [its 95% interval]" if len(seeds) >= FEWEST else ""
    return f", interquartile mean of {len(seeds)} training seeds{interval} (least to greatest)" if seeds else ""


def _best(measured: Sequence[tuple[str, list[Result]]]) -> str:
    """Which seed has the highest return, of each agent with several."""
    best = []
    for agent, results in measured:
        returns = {result.seed: value for result in results if (value := result.value("return_plain")) is not None}
        if len(returns) > 1:
            best.append(f"`{agent}` seed {max(returns, key=lambda seed: returns[seed])}")
    return f" Best seed by undisturbed return: {', '.join(best)}." if best else ""


def speeds_and_blends(folder: Path) -> Table | None:
    """The paper's experiments on speed and on blending policies; None before there is any result."""
    found = find(folder, "speeds.json") + find(folder, "interpolation.json")
    rows = [row for result in found for row in _walks(result)]
    return Table(("MuJoCo C, 2 kHz", "paper: policy", "ours", "command"), rows, [sources(found)]) if rows else None


def _walks(result: Result) -> list[tuple[str, ...]]:
    """A row for each agent of a result: how fast, or over which terrain, it walks."""
    rows = []
    agents = list(dict.fromkeys(row["agent"] for row in result.content["rows"]))
    told_speeds = [agent for agent in agents if " speed=" in agent]
    if told_speeds:
        rows.append((f"{told_speeds[0]} to {told_speeds[-1].split()[-1]}", NO_FIGURE, _kept(result, told_speeds)))
    for agent in agents:
        if agent in told_speeds:
            continue
        paper = PAPER_BLENDS.get(agent.removeprefix("blend:"), NO_FIGURE)
        told, h = (result.value(quantity, agent) for quantity in ("commanded_mps", "terrain_h_m"))
        speeds, ups = (result.values(quantity, agent) for quantity in ("speed_mps", "survived_s"))
        own = [row for row in result.content["rows"] if row["agent"] == agent]
        starts = [row for row in own if row.get("quantity") == "starts_up"]
        if told is not None and ups:
            paper = PAPER_SPEEDS.get(agent, NO_FIGURE)
            least = "at least " if min(ups) < max(ups) else ""
            ours = f"told {told:.2f} m/s: {span(speeds, 2) if speeds else NO_FIGURE}, up {least}{min(ups):g} of 10 s"
            plain = result.values("return_plain", agent)
            ours += f", return {span(plain, 1)} by the plain reward" if plain else ""
            seeds = dict.fromkeys(str(row["seed"]) for row in own if "seed" in row)
            ours += f"; training seeds {', '.join(seeds)}" if seeds else ""
        elif starts:
            slow, fast = (result.value(f"{end}_speed_mps", agent) for end in ("lowest", "highest"))
            ours = f"{starts[0]['value']:g} of {starts[0]['n']} starts up"
            ours += f", {slow:.2f} to {fast:.2f} m/s" if slow is not None and fast is not None else ""
        elif h is not None:
            ours = f"terrain up to h = {h:.2f} m"
        else:
            continue
        rows.append((agent, paper, ours))
    return [(*row, result.provenance["command"]) for row in rows]


def _kept(result: Result, agents: Sequence[str]) -> str:
    """How one policy keeps commanded speeds: those it walks 10 s at, and the largest error among them."""
    up = [agent for agent in agents if (result.value("survived_s", agent) or 0) >= WALK_S]
    pairs = [(result.value("speed_mps", agent), result.value("commanded_mps", agent)) for agent in up]
    errors = [abs(speed - told) for speed, told in pairs if speed is not None and told is not None]
    off = f", {max(errors):.2f} m/s off at most" if errors else ""
    return f"{len(up)} of {len(agents)} speeds up for 10 s{off}"


def verdicts(result: Result) -> Table:
    """The same trials on both engines: how many have the same outcome."""
    header = (
        "the same trials on both engines",
        "cells",
        "same verdict",
        "different at a limit of MuJoCo C",
        "elsewhere",
    )
    rows = [
        (
            row["kind"],
            str(row["cells"]),
            f"{row['same']} ({row['same_share']:.1%})",
            str(row["differ_at_border"]),
            str(row["differ_elsewhere"]),
            *(f"{row[key]:.0f} s" if (key := f"seconds_{engine}") in row else NO_FIGURE for engine in ENGINES),
            result.provenance["command"],
        )
        for row in result.content["rows"]
    ]
    took = (f"{name}, with set-up and compilation" for name in ENGINES.values())
    return Table((*header, *took, "command"), rows, [])


def engines(result: Result) -> Table:
    """The returns of each policy on both engines."""
    pairs = [(reward, engine) for reward in ("plain", "weighted") for engine in ENGINES]
    found: dict[tuple[str, ...], dict[tuple[str, str], float]] = {}
    for row in result.content["rows"]:
        origin = f"{ENGINES[row['trained_on']]} at {row['trained_at_hz']} Hz, {row['samples']:,} samples"
        returns = {(reward, row["walks_on"]): row[f"return_{reward}"] for reward in ("plain", "weighted")}
        found.setdefault((row["policy"], origin, str(row["physics_hz"])), {}).update(returns)
    rows = [
        (
            *key,
            *(f"{values[pair]:.1f}" if pair in values else NO_FIGURE for pair in pairs),
            result.provenance["command"],
        )
        for key, values in found.items()
    ]
    returned = (f"{reward} return on {ENGINES[engine]}" for reward, engine in pairs)
    return Table(("policy", "trained on", "physics in the test, Hz", *returned, "command"), rows, [])
