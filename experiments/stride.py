"""A policy's stride beside the reference's: `python -m experiments.stride policy=1x out=stride_1x.json`.

One robot in steady walking, MuJoCo C at 2 kHz, seen at every control step: the ten joint angles over a stride, and
where the feet stand over eight. Nothing in it is random.
"""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from cassie_mjx import cli
from cassie_mjx.agents.make import make_agent
from cassie_mjx.agents.policy import PolicyAgent
from cassie_mjx.configuration.values import Checked
from cassie_mjx.evaluation.film import film
from cassie_mjx.evaluation.trial import Trial
from cassie_mjx.motion.reference import ReferenceMotion, sample
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.robot import cassie
from cassie_mjx.robot.cassie import CONTROL_PERIOD_S
from cassie_mjx.robot.model import ModelConfig, load_model
from experiments.record_reference import foot_points

STRIDES = 8
# A foot that is lifted, and not only rocks, is at least this far above the floor, m.
LIFTED_M = 0.005


@dataclass(frozen=True)
class StrideConfig(Checked):
    """What walks."""

    policy: str = "1x"
    """A policy, as `cassie_mjx.evaluate` takes it."""
    out: str = "stride.json"
    """Result file."""
    overwrite: bool = False
    """Whether to replace a file that is no result of this experiment."""


def walked(policy: PolicyAgent, control_steps: int) -> np.ndarray:
    """Qpos [control_steps + 1, 35] of steady walking along x, from phase 0 of the stride on."""
    trial = Trial(0, (control_steps + 1) * CONTROL_PERIOD_S)
    return np.array([shot.qpos for shot in film(policy, trial, fps=1 / CONTROL_PERIOD_S)])


def reference(motion: ReferenceMotion, control_steps: int) -> np.ndarray:
    """Qpos [control_steps + 1, 35] of the motion, repeated."""
    return np.asarray(sample(motion, np.arange(control_steps + 1))[0], float)


def joint_angles(qpos: np.ndarray) -> dict[str, dict[str, list[float]]]:
    """Angles over time of each active joint, left and right, rad."""
    angles = qpos[:, cassie.ACTIVE_QPOS].reshape(len(qpos), len(cassie.SIDES), -1).round(5)
    return {
        joint: {side: angles[:, k, j].tolist() for k, side in enumerate(cassie.SIDES)}
        for j, joint in enumerate(cassie.ACTIVE)
    }


def placements(points: np.ndarray) -> list[list[float]]:
    """Where a foot stood, x and y, m, from the paths of its toe and heel [K, 2, 3].

    A place is the mean of a time on the floor between two in the air; the first and the last time count only if whole.
    """
    down = points[..., 2].min(axis=1) < LIFTED_M
    times = np.split(points.mean(axis=1)[:, :2], np.flatnonzero(np.diff(down)) + 1)
    # On and off the floor alternate; the first begins as the recording does.
    return [time.mean(axis=0).round(4).tolist() for time in times[1:-1][int(down[0]) :: 2]]


def beside(walk: Any, motion: Any) -> Any:
    """Two dictionaries as one, whose leaves are {"walked": ..., "reference": ...}."""
    if isinstance(walk, dict):
        return {key: beside(walk[key], motion[key]) for key in walk}
    return {"walked": walk, "reference": motion}


def main(config: StrideConfig) -> None:
    """Walk, compare and write the result."""
    out = cli.check_output(config.out, cli.RESULT, config.overwrite)
    policy = make_agent(config.policy)
    if not isinstance(policy, PolicyAgent):
        raise ValueError(f"policy={config.policy} imitates no reference; name a trained policy.")
    physics, samples = NativePhysics(load_model(ModelConfig())), len(policy.motion.qpos)
    both = [walked(policy, STRIDES * samples), reference(policy.motion, STRIDES * samples)]
    angles = [joint_angles(qpos[: samples + 1]) for qpos in both]
    points = [foot_points(physics, qpos).reshape(-1, 2, 2, 3) for qpos in both]
    feet = [{side: placements(path[:, k]) for k, side in enumerate(cassie.SIDES)} for path in points]
    error = np.abs(np.subtract(*both)[:samples, cassie.ACTIVE_QPOS])
    rows = [
        {"agent": policy.name, "quantity": quantity, "value": float(value), "unit": "rad", "n": 1}
        for quantity, value in (("joint_error_mean_rad", error.mean()), ("joint_error_max_rad", error.max()))
    ]
    cli.console().print(*rows, sep="\n")
    curves = {"time_s": (CONTROL_PERIOD_S * np.arange(samples + 1)).round(3).tolist(), "joints": beside(*angles)}
    provenance = cli.provenance(**asdict(config), agent=dict(policy.provenance))
    cli.write_result(out, {"rows": rows, **curves, "feet": beside(*feet), "provenance": provenance})


if __name__ == "__main__":
    cli.run(main, StrideConfig)
