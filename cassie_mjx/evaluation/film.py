"""A trial to look at: what the robot of one trial goes through, frame by frame. Nothing here draws."""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from cassie_mjx.envs.scenario import PUSH_S
from cassie_mjx.evaluation.trial import Subject, Trial, Walker, decide, disturbances, fallen, placed
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.robot import cassie
from cassie_mjx.robot.model import ModelConfig, load_model

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


def begin(subject: Subject, trial: Trial, phase: float) -> tuple[NativePhysics, Walker]:
    """The engine of a trial, and the one robot that starts it in steady walking at `phase` of its stride, 0 to 1."""
    physics = NativePhysics(load_model(ModelConfig()), trial.delay, threads=1, damping=subject.damping)
    starts = subject.start(physics, np.array([phase]))
    if trial.terrain:
        physics = NativePhysics(
            load_model(ModelConfig(scene="terrain")), trial.delay, threads=1, damping=subject.damping
        )
    return physics, placed(subject, starts, [trial])


def film(subject: Subject, trial: Trial, phase: float = 0.0, push_at: float = 0.0, fps: float = 30.0) -> Iterator[Shot]:
    """Conduct a trial, and see it `fps` times a second from its start on, until it ends or a second after a fall.

    Args:
      subject: what walks.
      trial: what it is put through; `start` does not matter.
      phase: phase of the stride at the start, 0 to 1.
      push_at: time of the push, s, rounded up to the next act; the heading is that of this moment.
      fps: 1/s.
    """
    physics, (state, memory) = begin(subject, replace(trial, start=0), phase)
    hertz = 1 / physics.model.opt.timestep
    act_steps, push_steps = round(subject.period_s * hertz), round(PUSH_S * hertz)
    push_step = act_steps * math.ceil(push_at * hertz / act_steps - 1e-9)
    unpushed = replace(trial, push=(0.0, 0.0))
    disturbance = disturbances([unpushed if push_step else trial], state, push_steps)
    now, target, fell_s = 0, np.zeros((1, cassie.NU)), None
    for frame in range(math.ceil(trial.seconds * fps - 1e-9)):
        step = round(frame / fps * hertz)
        while now < step:
            if now % act_steps == 0:
                target, memory = decide(subject, physics, Walker(state, memory), disturbance)
            steps = min(step, now - now % act_steps + act_steps) - now
            state, now = physics.advance(state, target, disturbance, steps), now + steps
            if now == push_step:
                disturbance = disturbances([trial], state, push_steps)
        pushed = disturbance.push_start <= state.step < disturbance.push_stop
        if fell_s is None and fallen(state.qpos, disturbance.terrain)[0]:
            fell_s = frame / fps
        yield Shot(frame / fps, state.qpos[0], disturbance.push[0] * pushed, fell_s)
        if fell_s is not None and frame / fps >= fell_s + AFTER_FALL_S:
            return
