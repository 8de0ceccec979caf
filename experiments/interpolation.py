"""Changing speed by blending policies: `python -m experiments.interpolation out=interpolation.json plot=speeds.png`.

Robots in steady walking at 20 phases of the stride are blended up to a faster policy and back, on MuJoCo C at 2 kHz:
0.5 to 1.0 and 1.0 to 1.5 m a stride, and from stepping in place through all policies in one run. Counted are falls, and
how far the speed, averaged over a stride, is from the blended reference's. The second part measures the terrain that
1x and 2x survive, and their blend that makes up for the loss of speed uphill.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from cassie_mjx import cli
from cassie_mjx.agents import blending
from cassie_mjx.agents.blend import BlendAgent
from cassie_mjx.agents.make import make_policy_agent
from cassie_mjx.agents.policy import PolicyAgent
from cassie_mjx.configuration.values import Checked
from cassie_mjx.envs.termination import fallen
from cassie_mjx.evaluation import suites
from cassie_mjx.evaluation.setup import EvalSetup
from cassie_mjx.evaluation.steady import steady, walk_on
from cassie_mjx.motion.reference import RAMP_PER_S
from cassie_mjx.physics.make import make_physics
from cassie_mjx.robot.cassie import CONTROL_PERIOD_S
from cassie_mjx.robot.ground import Ground
from cassie_mjx.robot.model import ModelConfig
from experiments import pictures

STARTS = 20


@dataclass(frozen=True)
class InterpolationConfig(Checked):
    """What to blend."""

    policies: tuple[str, str, str, str, str] = ("0x", "1x", "2x", "3x", "4x")
    """Policies for 0, 1, 2, 3 and 4 times the speed."""
    terrain: bool = True
    """Whether to measure the second part, too, which takes a few minutes."""
    out: str = "interpolation.json"
    """Result file."""
    plot: str = ""
    """File for a picture of the speeds; none if empty."""
    overwrite: bool = False
    """Whether to replace a file that is no result of this experiment."""


class Ride(NamedTuple):
    """Speeds of B robots whose command changes, each the mean over the stride that ends at the time."""

    time_s: np.ndarray
    """[T]."""
    commanded_mps: np.ndarray
    """[T]."""
    measured_mps: np.ndarray
    """[B, T]."""
    fell: np.ndarray
    """[B], bool."""

    @classmethod
    def of(cls, commanded_x: Sequence[float], x: Sequence[np.ndarray], fell: np.ndarray, stride: int) -> "Ride":
        """From pelvis x after every control step, as commanded and of the robots [B], m; `stride` in control steps."""
        stride_s = CONTROL_PERIOD_S * stride
        commanded, measured = (
            (np.array(way)[stride:] - np.array(way)[:-stride]) / stride_s for way in (commanded_x, x)
        )
        return cls(CONTROL_PERIOD_S * np.arange(stride, len(x)), commanded, measured.T, fell)

    @property
    def up_mps(self) -> np.ndarray:
        """`measured_mps` of the robots that did not fall."""
        return self.measured_mps[~self.fell]

    def rows(self, agent: str) -> list[dict[str, Any]]:
        """Starts without a fall, and of those the speed's range and error over the whole time."""
        up, n = self.up_mps, len(self.fell)
        figures = [("starts_up", float(len(up)), f"of {n}")]
        if len(up):
            error = np.sqrt(np.square(up - self.commanded_mps).mean())
            low, high = up.mean(axis=0).min(), up.mean(axis=0).max()
            names = ("speed_error_rms_mps", "lowest_speed_mps", "highest_speed_mps")
            figures += [(name, float(value), "m/s") for name, value in zip(names, (error, low, high), strict=True)]
        return [{"agent": agent, "quantity": name, "value": v, "unit": unit, "n": n} for name, v, unit in figures]

    def curve(self) -> dict[str, list[float]]:
        """What the picture shows, every 0.128 s: commanded speed, and mean, least and greatest of the robots up."""
        curves = {"time_s": self.time_s, "commanded_mps": self.commanded_mps}
        if len(up := self.up_mps):
            curves |= {"mean_mps": up.mean(axis=0), "least_mps": up.min(axis=0), "greatest_mps": up.max(axis=0)}
        return {name: np.round(values[::4], 3).tolist() for name, values in curves.items()}


def ride(blend: BlendAgent, starts: int = STARTS) -> Ride:
    """Blend up and down once, from `starts` phases of the stride."""
    physics = make_physics("native", ModelConfig())
    seconds = 2 * ((len(blend.policies) - 1) / RAMP_PER_S + blending.HOLD_S)
    fell, x, commanded_x = np.zeros(starts, bool), [], [0.0]
    walk = walk_on(blend, physics, steady(blend, physics, np.arange(starts) / starts))
    for state, carry in islice(walk, round(seconds / blend.period_s) + 1):
        fell |= fallen(state.qpos, Ground.flat(starts))
        x.append(state.qpos[:, 0])
        gain = blending.advance(blend.motions, blend.position(carry), carry.phase + 1)
        commanded_x.append(commanded_x[-1] + float(np.mean(gain)))
    return Ride.of(commanded_x[:-1], x, fell, len(blend.motions[0].qpos))


def rough_ground(policies: Sequence[PolicyAgent]) -> list[dict[str, Any]]:
    """Rows of the terrain that policies and their adaptive blend survive."""
    return [
        {"agent": agent.name, **metric._asdict()}
        for agent in (*policies, BlendAgent(policies, "adaptive"))
        for metric in suites.terrain(agent, EvalSetup()).metrics
    ]


def draw(rides: dict[str, Ride]) -> Figure:
    """Commanded and measured speeds over time, a panel for each ride."""
    figure = Figure(figsize=(5 * len(rides), 3.5), layout="constrained")
    axes = figure.subplots(1, len(rides), sharey=True, squeeze=False)[0]
    for axis, (name, walk) in zip(axes, rides.items(), strict=True):
        axis.plot(walk.time_s, walk.up_mps.T, color="tab:blue", lw=0.6, alpha=0.6)
        axis.plot(walk.time_s, walk.commanded_mps, color="black", lw=1.5, ls="--")
        axis.set(xlabel="s", title=f"{name}\n{len(walk.up_mps)} of {len(walk.fell)} up")
    axes[0].set_ylabel("speed over a stride, m/s\n(dashed: commanded)")
    return figure


def main(config: InterpolationConfig) -> None:
    """Ride, measure, write the result and draw it."""
    out = cli.check_output(config.out, cli.RESULT, config.overwrite)
    plot = pictures.check(config.plot, config.overwrite, out) if config.plot else None
    console, rides, rows = cli.console(), {}, []
    policies = [make_policy_agent(name) for name in config.policies]
    for chain in (policies[1:3], policies[2:4], policies):
        blend = BlendAgent(chain, "ramp")
        rides[blend.name] = ride(blend)
        found = rides[blend.name].rows(blend.name)
        rows += found
        console.print(*found, sep="\n")
    if config.terrain:
        found = rough_ground(policies[1:3])
        rows += found
        console.print(*found, sep="\n")
    curves = {name: walk.curve() for name, walk in rides.items()}
    provenance = cli.provenance(**asdict(config), agent={policy.name: policy.provenance for policy in policies})
    cli.write_result(out, {"rows": rows, "rides": curves, "provenance": provenance})
    if plot:
        pictures.save_figure(config.plot, plot, draw(rides))


if __name__ == "__main__":
    cli.run(main, InterpolationConfig)
