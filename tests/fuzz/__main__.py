"""Try to break the product: `python -m tests.fuzz files=2000 values=500 runs=20 kills=20 seed=0`.

Damages every kind of file that the project writes, gives wrong values to every command, and stops trainings at random
moments. Everything comes from the seed. Status 1 if anything was taken silently, lost, hung or ended in a traceback.
"""

import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cassie_mjx import cli
from cassie_mjx.configuration.values import Checked, Range, Seed
from tests.fuzz import files, kills, values
from tests.fuzz.outcome import FAULTS, Outcome, summary


@dataclass(frozen=True)
class FuzzConfig(Checked):
    """How much to try."""

    files: Annotated[int, Range(0, 10**9)] = 2000
    """Damages to each kind of file."""
    values: Annotated[int, Range(0, 10**9)] = 500
    """Wrong values to each command, which is not run."""
    runs: Annotated[int, Range(0, 10**9)] = 20
    """Wrong values to each command that is run to its end."""
    kills: Annotated[int, Range(0, 10**9)] = 20
    """Trainings that are stopped at random moments until they are done."""
    seed: Seed = 0
    """What all random choices come from."""


def attempts(config: FuzzConfig, folder: Path) -> Iterator[tuple[str, Iterator[Outcome]]]:
    """Each family of attempts."""
    yield "damaged files", files.attempts(folder, config.files, config.seed)
    yield "wrong values", values.attempts(config.values, config.seed)
    yield "wrong values, run", values.run_attempts(folder, config.runs, config.seed)
    yield "stopped trainings", kills.attempts(folder, config.kills, config.seed)


def main(config: FuzzConfig) -> None:
    """Try, and say what came of it."""
    faults = 0
    with tempfile.TemporaryDirectory() as folder:
        for name, family in attempts(config, Path(folder)):
            began = time.perf_counter()
            outcomes = list(family)
            faults += sum(outcome.kind in FAULTS for outcome in outcomes)
            print(f"{name}, {time.perf_counter() - began:.0f} s, {summary(outcomes)}", flush=True)
    sys.exit(1 if faults else 0)


if __name__ == "__main__":
    cli.run(main, FuzzConfig)
