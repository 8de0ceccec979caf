"""Who stays up, level by level: `python -m experiments.survival policy=1x out=FILE.json`.

`cassie_mjx.evaluate` looks for limits; here every height of the terrain and every delay is walked from all starts, in
MuJoCo C at 2 kHz, also those beyond a level that was not survived. Nothing in it is random.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from cassie_mjx import cli
from cassie_mjx.agents.make import AgentConfig
from cassie_mjx.agents.types import Agent
from cassie_mjx.evaluation.scheduler import run_trials
from cassie_mjx.evaluation.setup import LIMIT_PHASES, WALK_PHASES, WALK_S, EvalSetup
from cassie_mjx.evaluation.suites import HIGHEST_TERRAIN_M, LONGEST_DELAY_S, TERRAIN_STEP_M
from cassie_mjx.evaluation.trial import Trial
from cassie_mjx.robot.ground import Terrain

DELAY_STEP_MS = 1.0


@dataclass(frozen=True)
class SurvivalConfig(AgentConfig):
    """What walks, and where its result goes."""

    out: str = "survival.json"
    """Result file."""
    overwrite: bool = False
    """Whether to replace a file that is no result of this experiment."""


def terrain(agent: Agent, setup: EvalSetup) -> list[dict[str, Any]]:
    """The share of 8 starts that walk 10 s over the terrain z = h sin x, h from 0 to 0.8 m."""
    levels = np.arange(0, HIGHEST_TERRAIN_M + TERRAIN_STEP_M / 2, TERRAIN_STEP_M).round(9).tolist()
    trials = [Trial(start, WALK_S, terrain=Terrain("sine", h)) for h in levels for start in range(len(LIMIT_PHASES))]
    starts = setup.starts(agent, LIMIT_PHASES)
    result = run_trials(agent, setup.physics("terrain"), starts, trials, setup.progress, setup.num_envs)
    return rows(agent.name, "terrain_survived", "m", levels, ~result.fell)


def delay(agent: Agent, setup: EvalSetup) -> list[dict[str, Any]]:
    """The share of 10 starts that walk 10 s sensing what was up to 40 ms ago."""
    physics = setup.physics(longest_delay_s=LONGEST_DELAY_S)
    step_ms = 1000 * physics.model.opt.timestep
    levels = np.arange(0, 1000 * LONGEST_DELAY_S + DELAY_STEP_MS / 2, DELAY_STEP_MS).tolist()
    late = [round(level / step_ms) for level in levels]
    trials = [Trial(start, WALK_S, delay=steps) for steps in late for start in range(len(WALK_PHASES))]
    starts = setup.starts(agent, WALK_PHASES, LONGEST_DELAY_S)
    result = run_trials(agent, physics, starts, trials, setup.progress, setup.num_envs)
    return rows(agent.name, "delay_survived", "ms", levels, ~result.fell)


def rows(name: str, quantity: str, level_unit: str, levels: Sequence[float], up: np.ndarray) -> list[dict[str, Any]]:
    """A row for each level of a scenario, from whether the robots stayed up, [level x start]."""
    shares = up.reshape(len(levels), -1)
    row = {"agent": name, "quantity": quantity, "unit": "1", "n": shares.shape[1], "level_unit": level_unit}
    return [
        row | {"level": level, "value": float(share)} for level, share in zip(levels, shares.mean(axis=1), strict=True)
    ]


def main(config: SurvivalConfig) -> None:
    """Walk all levels and write the result."""
    out = cli.check_output(config.out, cli.RESULT, config.overwrite)
    agent, console = config.agent(), cli.console()
    with console.status("walking") as status:
        setup = EvalSetup(progress=lambda over, walking: status.update(f"{over} trials over, {walking} robots walking"))
        found = [*terrain(agent, setup), *delay(agent, setup)]
    for row in found:
        console.print(f"{row['quantity']:17} {row['level']:5g} {row['level_unit']:2} {row['value']:.2f}")
    provenance = cli.provenance(**asdict(config), agent=dict(agent.provenance))
    cli.write_result(out, {"rows": found, "provenance": provenance})


if __name__ == "__main__":
    cli.run(main, SurvivalConfig)
