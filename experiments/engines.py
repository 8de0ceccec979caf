"""Policies on the other engine: `python -m experiments.engines runs=[runs/native,runs/mjx] out=FILE.json`.

The best policy of each run walks undisturbed on MuJoCo C and on MJX, at several physics rates, from the ten phases
k/10 that training measures from. MuJoCo C at 2 kHz is what every return is measured by elsewhere; MJX has the
solver and contacts that it trains with.
"""

import json
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

from cassie_mjx import cli
from cassie_mjx.agents.numpy_policy import NumpyPolicy
from cassie_mjx.agents.policy import saved_agent
from cassie_mjx.configuration.values import Checked
from cassie_mjx.evaluation.returns import walk_returns
from cassie_mjx.physics.make import ENGINES, make_physics
from cassie_mjx.physics.types import Physics
from cassie_mjx.reporting.results import blaming
from cassie_mjx.robot.model import PhysicsHz, steps_per_control


@dataclass(frozen=True)
class EnginesConfig(Checked):
    """What to compare."""

    runs: tuple[str, ...] = ()
    """Directories of training runs."""
    rates: tuple[PhysicsHz, ...] = (2000, 1000, 500)
    """Physics rates, Hz."""
    out: str = "engines.json"
    """Result file."""
    overwrite: bool = False
    """Whether to replace a file that is no result of this experiment."""

    def __post_init__(self) -> None:
        """Raise ValueError for no run or rate, a run that is not there, or a rate that is none."""
        super().__post_init__()
        for name, example in (("runs", "runs/1x-seed0"), ("rates", "2000")):
            if not getattr(self, name):
                raise ValueError(f"{name} is empty; name at least one, such as {name}={example}.")
        for run in self.runs:
            if not (Path(run) / "best.npz").is_file():
                raise ValueError(f"{run} holds no best.npz; name the directories of training runs.")
        for rate in self.rates:
            steps_per_control(rate)


def engines(rate: int) -> dict[str, Physics]:
    """Both engines at a physics rate."""
    return {name: make_physics(name, replace(engine.training, physics_hz=rate)) for name, engine in ENGINES.items()}


def origin(run: str, policy: NumpyPolicy) -> dict[str, Any]:
    """What a run's policy was trained on. Raise ValueError if the run does not say so."""
    path = Path(run) / "config.json"
    with blaming(path):
        config = json.loads(path.read_text())["config"]
        engine, rate = config["physics"], config["physics_hz"]
        return {"trained_on": engine, "trained_at_hz": rate, "samples": policy.provenance["samples"]}


def main(config: EnginesConfig) -> None:
    """Walk each policy on each engine and write the returns."""
    out = cli.check_output(config.out, cli.RESULT, config.overwrite)
    policies = {run: NumpyPolicy.load(Path(run) / "best.npz") for run in config.runs}
    origins = {run: origin(run, policy) for run, policy in policies.items()}
    agents = {run: saved_agent(run, policy) for run, policy in policies.items()}
    rows: list[dict[str, Any]] = []
    for rate in config.rates:
        for (engine, physics), (run, agent) in product(engines(rate).items(), agents.items()):
            row = {"policy": run, **origins[run], "walks_on": engine, "physics_hz": rate}
            returns = walk_returns(agent, physics)
            rows.append(row | {name: round(value, 2) for name, value in returns.items()})
            cli.console().print(rows[-1])
    found = {run: policy.provenance for run, policy in policies.items()}
    cli.write_result(out, {"rows": rows, "policies": found, "provenance": cli.provenance(**asdict(config))})


if __name__ == "__main__":
    cli.run(main, EnginesConfig)
