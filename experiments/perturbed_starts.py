"""Walk from perturbed starts: `python -m experiments.perturbed_starts out=FILE.json`.

Each heuristic controller starts from random poses and velocities around standing still, the loops of the mechanism
closed, and walks for a minute in MuJoCo C at 2 kHz.
"""

from dataclasses import asdict, dataclass
from typing import Annotated, Any

import mujoco
import numpy as np

from cassie_mjx import cli
from cassie_mjx.agents.heuristic import HeuristicAgent
from cassie_mjx.configuration.values import Checked, Range, Seed
from cassie_mjx.evaluation.scheduler import run_trials
from cassie_mjx.evaluation.steady import begin
from cassie_mjx.evaluation.trial import EpisodeResult, Trial
from cassie_mjx.heuristic.config import CONTROLLERS
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.robot import cassie
from cassie_mjx.robot.loops import close_loops, close_loops_velocity
from cassie_mjx.robot.model import ModelConfig, load_model, standing
from experiments.record_reference import foot_points


@dataclass(frozen=True)
class PerturbedConfig(Checked):
    """How far from standing still to start; every value is drawn evenly from minus to plus the size given here."""

    robots: Annotated[int, Range(1, 100_000)] = 20
    """Starts."""
    seed: Seed = 0
    """Seed of the starts."""
    seconds: Annotated[float, Range(5, 3600)] = 60.0
    """Duration of the walk, s."""
    tilt_rad: Annotated[float, Range(0, 1.5)] = 0.06
    """Roll and pitch of the pelvis, and with it of the whole robot, rad."""
    joint_rad: Annotated[float, Range(0, 1.5)] = 0.06
    """Angles of the ten active joints, rad."""
    drop_m: Annotated[float, Range(0, 1)] = 0.02
    """Height of the lowest point of the feet over the floor, from 0 up, m."""
    pelvis_mps: Annotated[float, Range(0, 10)] = 0.25
    """Velocity of the pelvis along each axis, m/s."""
    pelvis_radps: Annotated[float, Range(0, 100)] = 0.25
    """Angular velocity of the pelvis about each axis, rad/s."""
    joint_radps: Annotated[float, Range(0, 100)] = 0.25
    """Velocities of the ten active joints, rad/s."""
    out: str = "perturbed_starts.json"
    """Result file."""
    overwrite: bool = False
    """Whether to replace a file that is no result of this experiment."""


def perturbed(config: PerturbedConfig, physics: NativePhysics) -> tuple[np.ndarray, np.ndarray]:
    """Starting states, qpos [robots, 35] and qvel [robots, 32]: loops closed, the lower foot close above the floor."""
    rng = np.random.default_rng(config.seed)
    pelvis = cassie.qvel_index("pelvis")
    pose, velocity = np.zeros(cassie.NV), np.zeros(cassie.NV)
    pose[pelvis[3:5]], pose[cassie.ACTIVE_QVEL] = config.tilt_rad, config.joint_rad
    velocity[pelvis[:3]], velocity[pelvis[3:]] = config.pelvis_mps, config.pelvis_radps
    velocity[cassie.ACTIVE_QVEL] = config.joint_radps
    moves, qvel = (size * rng.uniform(-1, 1, (config.robots, cassie.NV)) for size in (pose, velocity))
    qpos = np.tile(standing(physics.model), (config.robots, 1))
    for k, move in enumerate(moves):
        mujoco.mj_integratePos(physics.model, qpos[k], move, 1.0)
        qpos[k] = close_loops(physics.model, qpos[k])
        qvel[k] = close_loops_velocity(physics.model, qpos[k], qvel[k])
    lowest = foot_points(physics, qpos)[..., 2].min(axis=1)
    qpos[:, cassie.qpos_index("pelvis")[2]] += rng.uniform(0, config.drop_m, config.robots) - lowest
    return qpos, qvel


def walk(name: str, config: PerturbedConfig) -> EpisodeResult:
    """How the controller `name` of `CONTROLLERS` did from each of the starts, [robots]."""
    physics, agent = NativePhysics(load_model(ModelConfig())), HeuristicAgent(name)
    starts = begin(agent, physics, *perturbed(config, physics))
    return run_trials(agent, physics, starts, [Trial(k, config.seconds) for k in range(config.robots)])


def figures(result: EpisodeResult) -> list[tuple[str, float, str]]:
    """Quantity, value and unit: falls, and the extremes over the walks."""
    return [
        ("falls", float(result.fell.sum()), "1"),
        ("survived_s", float(result.survived_s.min()), "s"),
        ("speed_smallest_mps", float(result.speed_mps.min()), "m/s"),
        ("speed_largest_mps", float(result.speed_mps.max()), "m/s"),
        ("drift_m", float(np.abs(result.drift_m).max()), "m"),
    ]


def main(config: PerturbedConfig) -> None:
    """Walk, write the result and show it."""
    out = cli.check_output(config.out, cli.RESULT, config.overwrite)
    rows: list[dict[str, Any]] = []
    for name in CONTROLLERS:
        for quantity, value, unit in figures(walk(name, config)):
            figure = {"quantity": quantity, "value": value, "unit": unit, "n": config.robots}
            rows.append({"agent": f"controller:{name}", **figure})
            cli.console().print(rows[-1])
    cli.write_result(out, {"rows": rows, "provenance": cli.provenance(**asdict(config))})


if __name__ == "__main__":
    cli.run(main, PerturbedConfig)
