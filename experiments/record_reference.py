"""Record the reference motion from the heuristic controller: `python -m experiments.record_reference out=FILE.npz`.

Robots that aim at different speeds walk side by side from standing, in MuJoCo C at 2 kHz. After they have settled, one
stride is kept of the robot whose stride is nearest to half a metre, and made exactly periodic and symmetric. Nothing in
it is random. With `plot=FILE.png` the motion is drawn as curves, with `strip=FILE.png` as pictures.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Annotated, ClassVar

import mujoco
import numpy as np
from matplotlib.figure import Figure

from cassie_mjx import cli
from cassie_mjx.agents.heuristic import HeuristicAgent
from cassie_mjx.configuration.values import Checked, Range
from cassie_mjx.envs.termination import fallen
from cassie_mjx.evaluation.steady import begin, walk_on
from cassie_mjx.files.archive import is_kind
from cassie_mjx.heuristic.config import CONTROLLERS
from cassie_mjx.motion.files import FORMAT, save_motion
from cassie_mjx.motion.recording import heading_x, make_periodic, velocity_error
from cassie_mjx.motion.reference import ReferenceMotion
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.robot import cassie
from cassie_mjx.robot.cassie import CONTROL_PERIOD_S
from cassie_mjx.robot.drawing import load_scene, open_renderer
from cassie_mjx.robot.ground import Ground
from cassie_mjx.robot.loops import loop_error
from cassie_mjx.robot.model import ModelConfig, load_model
from experiments import pictures

STRIDE_M, STRIDE_TOLERANCE_M = 0.5, 0.02
MOTION = cli.Kind("a motion of ours", lambda path: is_kind(path, FORMAT))
FRAMES, FRAME_HEIGHT, FRAME_WIDTH = 8, 300, 190


Speed = Annotated[float, Range(-4, 4)]
"""m/s."""


@dataclass(frozen=True)
class RecordConfig(Checked):
    """What to record."""

    CHOICES: ClassVar[Mapping[str, Sequence[str]]] = {"preset": tuple(CONTROLLERS)}

    preset: str = "compliant"
    """"stiff" or "compliant", a preset of the controller."""
    speeds: tuple[Speed, ...] = (0.46, 0.49, 0.52, 0.55, 0.58, 0.61, 0.64, 0.67, 0.70, 0.73, 0.76, 0.79)
    """Speeds to aim at instead of the preset's own, one robot each, m/s."""
    strides: Annotated[int, Range(43, 10_000)] = 60
    """Strides of 0.704 s walked before the recorded one; 43 are 30 s, which the walk takes to settle."""
    out: str = "walk.npz"
    """File for the motion."""
    plot: str = ""
    """File for a picture of joint angles and foot heights; none if empty."""
    strip: str = ""
    """File for a strip of rendered frames; none if empty."""
    overwrite: bool = False
    """Whether to replace a file that is no motion or picture of ours."""

    def __post_init__(self) -> None:
        """Raise ValueError for a recording that cannot be made."""
        super().__post_init__()
        if not self.out.endswith(".npz"):
            raise ValueError(f"out={self.out} is no motion file; name one that ends in .npz.")
        if not self.speeds:
            raise ValueError("speeds is empty; name at least one speed in m/s.")


def walk(config: RecordConfig, physics: NativePhysics) -> tuple[np.ndarray, np.ndarray]:
    """Walk from standing, and record the stride after `config.strides` others, from a switch to the left leg on.

    Returns:
      (qpos [K + 1, B, 35], qvel [K + 1, B, 32]): the states at the K calls of the controller in that stride and at the
      first of the next, for the B speeds.
    """
    aims = replace(CONTROLLERS[config.preset], speed=np.array(config.speeds, np.float32))
    agent = HeuristicAgent(config.preset, aims)
    first = agent.acts_before(config.strides)
    starts = begin(agent, physics, *agent.initial_state(len(config.speeds)))
    walk = walk_on(agent, physics, starts)
    stride = [robots.physics for robots in islice(walk, first, first + agent.stride_acts + 1)]
    return np.array([state.qpos for state in stride]), np.array([state.qvel for state in stride])


def choose(qpos: np.ndarray) -> int:
    """The robot, of qpos [K + 1, B, 35], whose stride is nearest to 0.5 m and which is up.

    Raises:
      ValueError: none is within 0.02 m.
    """
    x, y = np.moveaxis(qpos[..., cassie.qpos_index("pelvis")[:2]], -1, 0)
    length = np.hypot(x[-1] - x[0], y[-1] - y[0])
    up = ~fallen(qpos, Ground.flat(qpos.shape[1])).any(axis=0)
    error = np.where(up, np.abs(length - STRIDE_M), np.inf)
    if error.min() > STRIDE_TOLERANCE_M:
        lengths = ", ".join(f"{m:.3f} m" if ok else "a fall" for m, ok in zip(length, up, strict=True))
        raise ValueError(f"No speed gives a stride of {STRIDE_M} m, but {lengths}; name other speeds.")
    return int(error.argmin())


def foot_points(physics: NativePhysics, qpos: np.ndarray) -> np.ndarray:
    """Lowest points of left toe, left heel, right toe and right heel in the world at qpos [K, 35], [K, 4, 3], m."""
    bodies = physics.bodies(physics.init(qpos, np.zeros((len(qpos), cassie.NV))))
    ends = [
        bodies.xpos[:, body] + bodies.xmat[:, body] @ end
        for body in cassie.FOOT_BODIES
        for end in (cassie.TOE, cassie.HEEL)
    ]
    return np.stack(ends, axis=1) - (0.0, 0.0, cassie.FOOT_RADIUS_M)


def slip(points: np.ndarray) -> float:
    """Farthest that one of the points [K, P, 3] goes along the floor while it is on it, m."""
    farthest = 0.0
    for path in np.moveaxis(points, 1, 0):
        down = path[:, 2] < 0
        for contact in np.split(path, np.flatnonzero(np.diff(down)) + 1):
            if contact[0, 2] < 0:
                farthest = max(farthest, np.linalg.norm(contact[:, :2] - contact[0, :2], axis=1).max())
    return float(farthest)


def statistics(
    physics: NativePhysics, qpos: np.ndarray, qvel: np.ndarray, motion: ReferenceMotion, period: float
) -> dict[str, float]:
    """How good the recorded stride was, and what was mended: m, rad, m/s, rad/s.

    Args:
      physics: the engine.
      qpos: the stride as walked, every `period` s, [K + 1, 35].
      qvel: its velocities, [K + 1, 32].
      motion: what has been made of it.
      period: s.
    """
    calls, samples = len(qpos) - 1, len(motion.qpos)
    straight, velocity = heading_x(qpos, qvel)
    x, y, z = cassie.qpos_index("pelvis")[:3]
    others = np.delete(np.arange(cassie.NQ), x)
    image = cassie.mirror_qpos(straight[calls // 2 :]) - straight[: calls // 2 + 1]
    # A walk beside the line is as symmetric as one on it.
    image[:, y] -= image[:, y].mean()
    mended = np.abs(motion.qpos - straight[: -1 : calls // samples])
    mismatch = velocity_error(motion, physics.model)
    return {
        "period_s": calls * period,
        "stride_length_m": float(motion.stride_length),
        "speed_mps": float(motion.stride_length) / (samples * CONTROL_PERIOD_S),
        "pelvis_height_min_m": float(motion.qpos[:, z].min()),
        "pelvis_height_max_m": float(motion.qpos[:, z].max()),
        "end_minus_start_qpos": float(np.abs(straight[-1, others] - straight[0, others]).max()),
        "end_minus_start_qvel": float(np.abs(velocity[-1] - velocity[0]).max()),
        "asymmetry_qpos": float(np.abs(image[:, others]).max()),
        "simulated_loop_error_m": float(loop_error(physics.model, qpos).max()),
        "loop_error_m": float(loop_error(physics.model, motion.qpos).max()),
        "slip_m": slip(foot_points(physics, qpos)),
        "mended_qpos": float(mended[:, others].max()),
        "qvel_minus_difference_active": float(mismatch[cassie.ACTIVE_QVEL].max()),
        "qvel_minus_difference": float(mismatch.max()),
    }


def draw(physics: NativePhysics, motion: ReferenceMotion) -> Figure:
    """The angles of the active joints and the heights of toes and heels over one stride."""
    time = CONTROL_PERIOD_S * np.arange(len(motion.qpos))
    angles = np.rad2deg(motion.qpos[:, cassie.ACTIVE_QPOS]).reshape(-1, 2, 5)
    heights = foot_points(physics, motion.qpos)[..., 2].reshape(-1, 2, 2)
    figure = Figure(figsize=(10, 5), layout="constrained")
    axes = figure.subplots(2, 3, sharex=True)
    for side, (name, colour) in enumerate(zip(cassie.SIDES, ("tab:blue", "tab:orange"), strict=True)):
        for joint, axis in enumerate(axes.flat[:5]):
            axis.plot(time, angles[:, side, joint], color=colour, label=name)
            axis.set(title=cassie.ACTIVE[joint], ylabel="degrees")
        for end, style in enumerate(("-", "--")):
            axes[1, 2].plot(time, 1000 * heights[:, side, end], style, color=colour)
    axes[1, 2].set(title="height of toe, heel (dashed)", ylabel="mm")
    for axis in axes[1]:
        axis.set_xlabel("s")
    axes[0, 0].legend()
    return figure


def render(motion: ReferenceMotion) -> np.ndarray:
    """Frames of one stride, evenly spaced, side by side."""
    scene = load_scene()
    data = mujoco.MjData(scene)
    frames = []
    with open_renderer(scene, FRAME_WIDTH, FRAME_HEIGHT) as renderer:
        for k in np.arange(FRAMES) * len(motion.qpos) // FRAMES:
            data.qpos[:] = motion.qpos[k]
            mujoco.mj_forward(scene, data)
            renderer.update_scene(data, camera="side")
            frames.append(renderer.render())
    return np.concatenate(frames, axis=1)


def record(config: RecordConfig) -> tuple[ReferenceMotion, dict[str, float]]:
    """The motion, and figures of it and of the walk that it comes from."""
    physics = NativePhysics(load_model(ModelConfig()))
    qpos, qvel = walk(config, physics)
    chosen = choose(qpos)
    qpos, qvel = qpos[:, chosen], qvel[:, chosen]
    period = CONTROLLERS[config.preset].period
    every = round(CONTROL_PERIOD_S / period)
    motion = make_periodic(qpos[::every], qvel[::every], physics.model)
    figures = statistics(physics, qpos, qvel, motion, period)
    return motion, {"controller_speed_mps": config.speeds[chosen], **figures}


def main(config: RecordConfig) -> None:
    """Record, print the figures, and write the motion and its pictures."""
    out = cli.check_output(config.out, MOTION, config.overwrite)
    plot = pictures.check(config.plot, config.overwrite) if config.plot else None
    strip = pictures.check(config.strip, config.overwrite, *filter(None, [plot])) if config.strip else None
    motion, figures = record(config)
    for name, value in figures.items():
        cli.console().print(f"{name:30} {value:.6g}")
    save_motion(out, motion, cli.provenance(preset=config.preset, strides=config.strides, **figures))
    if plot:
        pictures.save_figure(config.plot, plot, draw(NativePhysics(load_model(ModelConfig())), motion))
    if strip:
        pictures.save_image(config.strip, strip, render(motion))


if __name__ == "__main__":
    cli.run(main, RecordConfig)
