"""A trial to look at: what the robot of one trial goes through, frame by frame. Nothing here draws."""

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import chain
from typing import NamedTuple

import numpy as np

from cassie_mjx.agents.types import Agent, AgentState
from cassie_mjx.envs.termination import has_fallen, height_over_ground
from cassie_mjx.evaluation.simulate import Moment, act_steps, simulate
from cassie_mjx.evaluation.steady import steady
from cassie_mjx.evaluation.trial import Trial, placed, scenario_of
from cassie_mjx.physics.make import make_physics
from cassie_mjx.physics.types import Physics, Scenario
from cassie_mjx.robot.model import ModelConfig

# A film goes on for so long after a fall.
AFTER_FALL_S = 1.0


class Shot(NamedTuple):
    """What one frame shows."""

    time_s: float
    """Since the start."""
    qpos: np.ndarray
    """[35], in MuJoCo's order."""
    push_w: np.ndarray
    """Force at the pelvis, world frame, [3], N."""
    fell_s: float | None
    """Time of the first frame that showed a fallen robot; None as long as it is up."""


def begin(agent: Agent, trial: Trial, phase: float, electronics: bool = False) -> tuple[Physics, AgentState]:
    """The engine of a trial, and the one robot that starts it in steady walking at `phase` of its stride, 0 to 1."""
    config = ModelConfig(electronics=electronics)
    physics = make_physics("native", config, trial.delay, threads=1)
    robots = placed(agent, steady(agent, physics, np.array([phase])), [trial])
    if trial.terrain.level:
        config = replace(config, scene=trial.terrain.ground.scene)
        physics = make_physics("native", config, trial.delay, threads=1)
    return physics, robots


def film(
    agent: Agent,
    trial: Trial,
    phase: float = 0.0,
    push_at: float = 0.0,
    fps: float = 30.0,
    electronics: bool = False,
) -> Iterator[Shot]:
    """Run a trial, and see it `fps` times a second from its start on, until it ends or a second after a fall.

    Args:
      agent: what walks.
      trial: what it is put through; `start` does not matter.
      phase: phase of the stride at the start, 0 to 1.
      push_at: time that the pushes count from, s, rounded up to the agent's next step; the heading is that of then.
      fps: 1/s.
      electronics: whether encoders, filters and motors are the robot's (`robot.electronics`).
    """
    physics, robots = begin(agent, replace(trial, start=0), phase, electronics)
    hertz, steps = 1 / physics.model.opt.timestep, act_steps(agent, physics)
    push_step = steps * math.ceil(push_at * hertz / steps - 1e-9)
    frames = [round(frame / fps * hertz) for frame in range(math.ceil(trial.seconds * fps - 1e-9))]
    fell_s = None
    for frame, (moment, scenario) in enumerate(_watched(agent, physics, robots, trial, push_step, frames)):
        state, time_s = moment.robots.physics, frame / fps
        if fell_s is None and has_fallen(height_over_ground(state.qpos, scenario.ground))[0]:
            fell_s = time_s
        yield Shot(time_s, state.qpos[0], scenario.force(state.step)[0], fell_s)
        if fell_s is not None and time_s >= fell_s + AFTER_FALL_S:
            return


def _watched(
    agent: Agent, physics: Physics, robots: AgentState, trial: Trial, push_step: int, frames: list[int]
) -> Iterator[tuple[Moment, Scenario]]:
    """The robot at each frame, given in physics steps since the start; it is pushed from `push_step` on."""
    hertz = 1 / physics.model.opt.timestep
    before = [step for step in frames if step < push_step]
    scenario = scenario_of(agent, [replace(trial, pushes=())], robots.physics, hertz)
    after = [step - push_step for step in frames[len(before) :]]
    for moment in simulate(agent, physics, robots, scenario, chain(before, [push_step] if after else [])):
        robots = moment.robots
        if moment.step < push_step:
            yield moment, scenario
    scenario = scenario_of(agent, [trial], robots.physics, hertz, max(len(trial.pushes), 1))
    for moment in simulate(agent, physics, robots, scenario, after):
        yield moment, scenario
