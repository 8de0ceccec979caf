"""The same trials of a policy on MJX and on MuJoCo C: `python -m experiments.verdicts policy=1x out=FILE.json`.

A grid of 528 cells, chosen before any was walked: pushes, terrain and delays from harmless to hopeless. Both engines
run at 2 kHz with full contacts, from the same states; MJX in float32, and with a tangent plane under each leg
where MuJoCo C has a height field. A trial at the border, where the next level of the disturbance changes the outcome,
may well end otherwise; no other should.
"""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from cassie_mjx import cli
from cassie_mjx.agents.make import AgentConfig
from cassie_mjx.agents.types import Agent
from cassie_mjx.evaluation.pushes import pushed, towards
from cassie_mjx.evaluation.scheduler import run_trials
from cassie_mjx.evaluation.setup import LIMIT_PHASES, WALK_S, EvalSetup
from cassie_mjx.evaluation.trial import Trial
from cassie_mjx.physics.make import ENGINES
from cassie_mjx.robot.ground import Terrain
from cassie_mjx.robot.model import ModelConfig

DIRECTIONS_DEG = np.arange(8) * 45.0
FORCES_N = np.arange(20, 241, 20)
HEIGHTS_M = np.arange(1, 9) * 0.05
DELAYS = np.arange(1, 11) * 4
"""Physics steps at 2 kHz, so 2 to 20 ms."""


@dataclass(frozen=True)
class VerdictsConfig(AgentConfig):
    """What to compare."""

    out: str = "verdicts.json"
    """Result file."""
    overwrite: bool = False
    """Whether to replace a file that is no result of this experiment."""


@dataclass(frozen=True)
class Subset:
    """Cells of one kind."""

    kind: str
    trials: Sequence[Sequence[Trial]]
    """In groups (a phase, or a direction and a phase) and, within each, in levels from weak to strong."""
    scene: str = "flat"
    """Scene of both engines."""
    longest_delay_s: float = 0.0
    """What the engine must be made for."""


def subsets() -> list[Subset]:
    """The grid."""
    phases = range(len(LIMIT_PHASES))
    pushes = [
        [pushed(phase, towards(degrees), force) for force in FORCES_N.tolist()]
        for degrees in DIRECTIONS_DEG
        for phase in phases[::2]
    ]
    hills = [[Trial(phase, WALK_S, terrain=Terrain("sine", h)) for h in HEIGHTS_M.tolist()] for phase in phases]
    delays = [[Trial(phase, WALK_S, delay=steps) for steps in DELAYS.tolist()] for phase in phases]
    return [
        Subset("push", pushes),
        Subset("terrain", hills, scene="terrain"),
        Subset("delay", delays, longest_delay_s=DELAYS.max() / ModelConfig().physics_hz),
    ]


def survived(agent: Agent, setup: EvalSetup, subset: Subset) -> np.ndarray:
    """Which of the cells [group, level] are survived."""
    starts = setup.starts(agent, LIMIT_PHASES, subset.longest_delay_s)
    physics = setup.physics(subset.scene, subset.longest_delay_s)
    trials = [trial for group in subset.trials for trial in group]
    result = run_trials(agent, physics, starts, trials, setup.progress, setup.num_envs)
    return ~result.fell.reshape(len(subset.trials), -1)


def at_border(verdicts: np.ndarray) -> np.ndarray:
    """Whether the next weaker or stronger level of a cell [group, level] has another verdict."""
    change = verdicts[:, 1:] != verdicts[:, :-1]
    return np.pad(change, ((0, 0), (1, 0))) | np.pad(change, ((0, 0), (0, 1)))


def row(kind: str, native: np.ndarray, mjx: np.ndarray, border: np.ndarray) -> dict[str, Any]:
    """How two engines' verdicts on the same cells, and the border of MuJoCo C, compare."""
    differ = native != mjx
    return {
        "kind": kind,
        "cells": native.size,
        "survived_native": int(native.sum()),
        "survived_mjx": int(mjx.sum()),
        "same": int((~differ).sum()),
        "same_share": float((~differ).mean()),
        "differ_at_border": int((differ & border).sum()),
        "differ_elsewhere": int((differ & ~border).sum()),
    }


def main(config: VerdictsConfig) -> None:
    """Walk the cells on both engines and write what differs."""
    out, console = cli.check_output(config.out, cli.RESULT, config.overwrite), cli.console()
    agent = config.agent()
    rows, differing, verdicts = [], [], []
    for subset in subsets():
        found, seconds = {}, {}
        for engine in ENGINES:
            began = time.perf_counter()
            with console.status(f"{subset.kind} on {engine}"):
                found[engine] = survived(agent, EvalSetup(engine), subset)
            seconds[f"seconds_{engine}"] = round(time.perf_counter() - began, 1)
        native, mjx = found["native"], found["mjx"]
        border = at_border(native)
        verdicts.append(np.stack([native, mjx, border]).reshape(3, -1))
        rows.append(row(subset.kind, native, mjx, border) | seconds)
        console.print(rows[-1])
        for group, level in np.argwhere(native != mjx).tolist():
            differing.append({"survived_on": "native" if native[group, level] else "mjx"})
            differing[-1] |= {"at_border": bool(border[group, level]), "trial": vars(subset.trials[group][level])}
    rows.append(row("all", *np.concatenate(verdicts, axis=1)))
    console.print(rows[-1])
    provenance = cli.provenance(**asdict(config), agent=dict(agent.provenance))
    cli.write_result(out, {"rows": rows, "differing": differing, "provenance": provenance})


if __name__ == "__main__":
    cli.run(main, VerdictsConfig)
