"""Films of a policy in training: a few seconds from the start of the reference motion, drawn small."""

from itertools import islice
from pathlib import Path

import numpy as np

from cassie_mjx.agents.policy import PolicyAgent
from cassie_mjx.evaluation.draw import draw_frames, write_video
from cassie_mjx.evaluation.film import Shot
from cassie_mjx.evaluation.steady import begin, walk_on
from cassie_mjx.physics.make import make_physics
from cassie_mjx.robot.cassie import CONTROL_PERIOD_S
from cassie_mjx.robot.drawing import load_scene, open_renderer
from cassie_mjx.robot.model import ModelConfig

SECONDS, WIDTH, HEIGHT = 4.0, 320, 240


def film_policy(path: Path, agent: PolicyAgent, electronics: bool) -> None:
    """Write a film, .gif or .mp4, of a policy that walks undisturbed in MuJoCo C at 2 kHz; also when it falls.

    Args:
      path: of the film.
      agent: the policy.
      electronics: whether encoders, filters and motors are the robot's (`robot.electronics`).

    Raises:
      ValueError: nothing can draw here.
      OSError: the film cannot be written.
    """
    physics = make_physics("native", ModelConfig(electronics=electronics), threads=1)
    walk = walk_on(agent, physics, begin(agent, physics, *agent.initial_state(1)))
    robots = islice(walk, round(SECONDS / CONTROL_PERIOD_S))
    shots = [Shot(k * CONTROL_PERIOD_S, each.physics.qpos[0], np.zeros(3), None) for k, each in enumerate(robots)]
    with open_renderer(load_scene(), WIDTH, HEIGHT) as renderer:
        frames = draw_frames(renderer, shots, "three-quarter")
        write_video(path, frames, WIDTH, HEIGHT, 1 / CONTROL_PERIOD_S)
