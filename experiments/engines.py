"""Policies on the other engine: `python -m experiments.engines runs=[runs/native,runs/mjx] out=FILE.json`.

The best policy of each run walks undisturbed on MuJoCo C and on MJX, at several physics rates, from the ten phases of
`return_plain` and `return_weighted`. MuJoCo C at 2 kHz is what every return is measured by elsewhere; MJX has the
solver and contacts that it trains with.
"""

import json
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

from rich.console import Console

from cassie_mjx import cli
from cassie_mjx.agents.numpy_policy import NumpyPolicy
from cassie_mjx.agents.policy import saved_agent
from cassie_mjx.configuration.values import Checked
from cassie_mjx.evaluation.returns import walk_returns
from cassie_mjx.physics.make import make_physics
from cassie_mjx.physics.types import Physics
from cassie_mjx.robot.model import MJX_TRAINING, ModelConfig, PhysicsHz, steps_per_control


@dataclass(frozen=True)
class EnginesConfig(Checked):
    """What to compare."""

    runs: tuple[str, ...] = ()
    """Directories of training runs."""
    rates: tuple[PhysicsHz, ...] = (2000, 1000, 500)
    """Physics rates, Hz."""
    out: str = "engines.json"
    """Result file."""

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
    models = {"native": ModelConfig(physics_hz=rate), "mjx": replace(MJX_TRAINING, physics_hz=rate)}
    return {engine: make_physics(engine, model) for engine, model in models.items()}


def main(config: EnginesConfig) -> None:
    """Walk each policy on each engine and write the returns."""
    out = cli.check_writable(config.out)
    policies = {run: NumpyPolicy.load(Path(run) / "best.npz") for run in config.runs}
    held = {run: json.loads((Path(run) / "config.json").read_text()) for run in config.runs}
    agents = {run: saved_agent(run, policy) for run, policy in policies.items()}
    rows: list[dict[str, Any]] = []
    for rate in config.rates:
        for (engine, physics), (run, agent) in product(engines(rate).items(), agents.items()):
            trained = held[run]["config"]
            row = {
                "policy": run,
                "trained_on": trained["physics"],
                "trained_at_hz": trained["physics_hz"],
                "samples": policies[run].provenance["samples"],
                "walks_on": engine,
                "physics_hz": rate,
            }
            returns = walk_returns(agent, physics)
            rows.append(row | {name: round(value, 2) for name, value in returns.items()})
            Console(stderr=True).print(rows[-1])
    origins = {run: policy.provenance for run, policy in policies.items()}
    cli.write_json(out, {"rows": rows, "policies": origins, "provenance": cli.provenance(**asdict(config))})


if __name__ == "__main__":
    cli.run(main, EnginesConfig)
