"""Which parts of Cassie can touch in walking: `python -m experiments.contacts out=FILE.json`.

Both heuristic controllers walk with every contact of the published model, undisturbed and recovering from pushes in
four directions at eight phases of the stride. For each pair of geoms the smallest distance over all robots that stayed
up says whether the pair is needed.
"""

from dataclasses import dataclass
from itertools import islice
from typing import Annotated

import mujoco
import numpy as np

from cassie_mjx import cli
from cassie_mjx.agents.heuristic import HeuristicAgent
from cassie_mjx.configuration.values import Checked, Range
from cassie_mjx.envs.termination import fallen
from cassie_mjx.evaluation.pushes import DIRECTIONS
from cassie_mjx.evaluation.setup import LIMIT_PHASES
from cassie_mjx.evaluation.steady import steady, walk_on
from cassie_mjx.evaluation.trial import Push, Trial, placed, scenario_of
from cassie_mjx.heuristic.config import CONTROLLERS
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.robot.cassie import CONTROL_PERIOD_S
from cassie_mjx.robot.ground import Ground
from cassie_mjx.robot.mjcf import WALKING_PAIRS
from cassie_mjx.robot.model import ModelConfig, load_model

FAR_M = 0.5


@dataclass(frozen=True)
class ContactsConfig(Checked):
    """What to walk through."""

    out: str = "contacts.json"
    """Result file."""
    overwrite: bool = False
    """Whether to replace a file that is no result of this experiment."""
    push_n: Annotated[float, Range(0, 1000)] = 60.0
    """Force of the 0.2 s pushes, N."""
    seconds: Annotated[float, Range(0.1, 600)] = 4.0
    """Walking after the push begins, s."""


def trajectories(name: str, push_n: float, seconds: float) -> np.ndarray:
    """Qpos [samples, 35], every 32 ms, of a controller's robots that stay up."""
    physics = NativePhysics(load_model(ModelConfig(contacts="published")))
    agent = HeuristicAgent(name)
    starts = steady(agent, physics, LIMIT_PHASES)
    phases = range(len(LIMIT_PHASES))
    trials = [Trial(k, seconds, (Push(push_n * x, push_n * y),)) for x, y in DIRECTIONS.values() for k in phases]
    robots = placed(agent, starts, trials)
    scenario = scenario_of(agent, trials, robots.physics, 1 / physics.model.opt.timestep)
    every, calls = (round(time / agent.period_s) for time in (CONTROL_PERIOD_S, seconds))
    walk = islice(walk_on(agent, physics, robots, scenario), 0, calls, every)
    qpos = np.array([moment.physics.qpos for moment in walk])
    up = ~fallen(qpos, Ground.flat(len(trials))).any(axis=0)
    return qpos[:, up].reshape(-1, qpos.shape[-1])


def smallest_distances(qpos: np.ndarray) -> dict[str, float]:
    """Smallest distance between the geoms of each pair over qpos [samples, 35], m; negative where they overlap."""
    model = load_model(ModelConfig(contacts="published"))
    data = mujoco.MjData(model)
    smallest = np.full(model.npair, FAR_M)
    for configuration in qpos:
        data.qpos[:] = configuration
        mujoco.mj_kinematics(model, data)
        for i, (geom1, geom2) in enumerate(zip(model.pair_geom1, model.pair_geom2, strict=True)):
            smallest[i] = min(smallest[i], mujoco.mj_geomDistance(model, data, geom1, geom2, FAR_M, None))
    return {model.pair(i).name: float(distance) for i, distance in enumerate(smallest)}


def main(config: ContactsConfig) -> None:
    """Walk, measure and write the result."""
    out = cli.check_output(config.out, cli.RESULT, config.overwrite)
    rows = []
    for name in CONTROLLERS:
        for push_n in (0.0, config.push_n):
            qpos = trajectories(name, push_n, config.seconds)
            for pair, distance in sorted(smallest_distances(qpos).items(), key=lambda item: item[1]):
                kept = "walking" if pair in WALKING_PAIRS else "full" if "hip-pitch" not in pair else "published"
                rows.append(
                    {
                        "agent": f"controller:{name}",
                        "push_N": push_n,
                        "pair": pair,
                        "smallest_distance_mm": round(1000 * distance, 1),
                        "contacts": kept,
                        "samples": len(qpos),
                    }
                )
                cli.console().print(rows[-1])
    cli.write_result(out, {"rows": rows, "provenance": cli.provenance()})


if __name__ == "__main__":
    cli.run(main, ContactsConfig)
