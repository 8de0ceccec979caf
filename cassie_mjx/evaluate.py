"""Measure an agent: `python -m cassie_mjx.evaluate policy=1x suite=all out=FILE.json`.

What is measured and how, `cassie_mjx.evaluation.suites` says. What is drawn is drawn with seed 0: the same command
gives the same figures.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, ClassVar

from rich.status import Status
from rich.table import Table

from cassie_mjx import cli
from cassie_mjx.agents.make import AgentConfig
from cassie_mjx.evaluation.setup import PHASES, EvalSetup
from cassie_mjx.evaluation.suites import ALL, HIGHEST_TRIED, SUITES
from cassie_mjx.physics.make import ENGINES


@dataclass(frozen=True)
class EvaluateConfig(AgentConfig):
    """What to measure."""

    CHOICES: ClassVar[Mapping[str, Sequence[str]]] = {"suite": (*SUITES, "all"), "physics": tuple(ENGINES)}

    suite: str = "all"
    """"walk", "delay", "terrain", "push", "all" of them, "ground": slopes, steps and rough ground, "map": all pushes in
    16 directions, "forces": pushes of 0.1 to 1 s, two pushes, steady forces and random pushes for a minute,
    "dynamics": robots that differ in mass, friction, springs, motors and encoders, "sensors": noise, a leaning IMU,
    encoders that are off and a drifting heading, with electronics, or "command": how a policy follows forward and
    lateral velocities and yaw rates."""
    long: bool = False
    """Whether what lasts 10 s is done for 60 s as well; those quantities end in _60s."""
    physics: str = "native"
    """The engine: "native", MuJoCo C, which every headline figure comes from, or "mjx"; both at 2 kHz."""
    electronics: bool = False
    """Whether robots sense what Cassie's encoders and filters show, with torques that speed limits and that are 3 ms
    late."""
    out: str = "evaluation.json"
    """Result file."""
    overwrite: bool = False
    """Whether to replace a file that is no evaluation."""


def main(config: EvaluateConfig) -> None:
    """Measure, show each suite's figures as it ends, and write the result."""
    out = cli.check_output(config.out, cli.RESULT, config.overwrite)
    console = cli.console()
    agent = config.agent()
    rows: list[dict[str, Any]] = []
    cells: dict[str, Any] = {}
    seconds: dict[str, float] = {}
    for suite in ALL if config.suite == "all" else (config.suite,):
        began = time.perf_counter()
        with console.status(f"{suite}: walking up to speed") as status:
            progress = partial(_show, status, suite)
            result = SUITES[suite](agent, EvalSetup(config.physics, config.long, progress, config.electronics))
        seconds[suite] = round(time.perf_counter() - began, 1)
        found = [{"agent": agent.name, **metric._asdict()} for metric in result.metrics]
        console.print(table(f"{agent.name}: {suite}", found))
        rows += found
        if result.cells is not None:
            cells[suite] = result.cells
    provenance = cli.provenance(
        **asdict(config), phases=PHASES, highest=HIGHEST_TRIED, agent=dict(agent.provenance), seconds=seconds
    )
    cli.write_result(out, {"rows": rows, **cells, "provenance": provenance})


def _show(status: Status, suite: str, over: int, walking: int) -> None:
    status.update(f"{suite}: {over} trials over, {walking} robots walking")


def table(title: str, rows: Sequence[dict[str, Any]]) -> Table:
    """The rows for reading."""
    shown = Table("quantity", "value", "unit", "n", title=title)
    for row in rows:
        shown.add_row(row["quantity"], f"{row['value']:.4g}", row["unit"], str(row["n"]))
    return shown


def run() -> None:
    """Read the command line, and do it."""
    cli.run(main, EvaluateConfig)


if __name__ == "__main__":
    run()
