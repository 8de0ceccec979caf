"""A walk as a video: `python -m cassie_mjx.render policy=1x out=walk.mp4`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from rich.progress import track

from cassie_mjx import cli
from cassie_mjx.agents.make import AgentConfig
from cassie_mjx.configuration.values import Range
from cassie_mjx.evaluation.draw import ENCODINGS, FASTEST_GIF, FILM, draw_frames, write_video
from cassie_mjx.evaluation.film import film
from cassie_mjx.evaluation.trial import Push, Trial
from cassie_mjx.robot.drawing import CAMERAS, load_scene, open_renderer
from cassie_mjx.robot.ground import parse_terrain
from cassie_mjx.robot.model import ModelConfig


@dataclass(frozen=True)
class RenderConfig(AgentConfig):
    """What to film."""

    CHOICES: ClassVar[Mapping[str, Sequence[str]]] = {"camera": CAMERAS}

    out: str = "walk.mp4"
    """Video file, .mp4, .gif or .webp."""
    overwrite: bool = False
    """Whether to replace a file that is no film of ours."""
    seconds: Annotated[float, Range(0.01, 3600)] = 10.0
    """Duration, s; a film ends a second after a fall."""
    phase: Annotated[float, Range(0, 1)] = 0.0
    """Phase of the stride at which the film begins."""
    push: tuple[Annotated[float, Range(-1000, 1000)], Annotated[float, Range(-1000, 1000)]] = (0.0, 0.0)
    """Force at the pelvis for 0.2 s, forward and left, N."""
    push_at: Annotated[float, Range(0, 3600)] = 2.0
    """Time of the push since the start, s, before the end; it begins with the next act."""
    terrain: str = "0"
    """What is walked on: height h of hills z = h sin x, m, or a kind and its level, slope:0.2 or across:0.2 (rad),
    steps:0.1 or rough:0.1 (m)."""
    delay: Annotated[float, Range(0, 1000)] = 0.0
    """Age of the state that policy and PD loop see, ms, in whole physics steps of 0.5 ms."""
    electronics: bool = False
    """Whether the robot senses what Cassie's encoders and filters show, with torques that speed limits and that are
    3 ms late."""
    camera: str = "three-quarter"
    """"three-quarter", "side" or "front"; each follows the robot."""
    width: Annotated[int, Range(16, 4096)] = 960
    """Pixels, an even number."""
    height: Annotated[int, Range(16, 4096)] = 720
    """Pixels, an even number."""
    fps: Annotated[float, Range(1, 1000)] = 30.0
    """Frames a second, in real time."""

    def __post_init__(self) -> None:
        """Raise ValueError for a film that cannot be made."""
        super().__post_init__()
        parse_terrain(self.terrain)
        suffix, step_ms = Path(self.out).suffix, 1000 / ModelConfig().physics_hz
        for name, valid, hint in (
            ("out", suffix in ENCODINGS, f"name a file that ends in {', '.join(ENCODINGS)}"),
            ("push_at", not any(self.push) or self.push_at < self.seconds, f"the film ends at {self.seconds:g} s"),
            ("delay", self.delay % step_ms == 0, f"use a multiple of {step_ms:g} ms"),
            ("width", self.width % 2 == 0, "use an even number"),
            ("height", self.height % 2 == 0, "use an even number"),
            ("fps", suffix != ".gif" or self.fps <= FASTEST_GIF, f"a GIF has at most {FASTEST_GIF}"),
        ):
            if not valid:
                raise ValueError(f"{name}={getattr(self, name)} cannot be filmed; {hint}.")

    @property
    def trial(self) -> Trial:
        """The trial that is filmed."""
        delay_steps = round(self.delay * ModelConfig().physics_hz / 1000)
        return Trial(0, self.seconds, (Push(*self.push),), parse_terrain(self.terrain), delay_steps)


def main(config: RenderConfig) -> None:
    """Film the walk, and say how it went."""
    cli.check_output(config.out, FILM, config.overwrite)
    agent, console = config.agent(), cli.console()
    with open_renderer(load_scene(config.trial.terrain.ground), config.width, config.height) as renderer:
        with console.status("walking"):
            shots = list(film(agent, config.trial, config.phase, config.push_at, config.fps, config.electronics))
        drawn = track(shots, "drawing", console=console, transient=True)
        frames = draw_frames(renderer, drawn, config.camera, config.trial.terrain.ground)
        write_video(Path(config.out), frames, config.width, config.height, config.fps)
    fell_s = shots[-1].fell_s
    how = "stayed up" if fell_s is None else f"fell after {fell_s:.2f} s"
    console.print(f"{config.out}: {agent.name} {how}.", soft_wrap=True)


def run() -> None:
    """Read the command line, and do it."""
    cli.run(main, RenderConfig)


if __name__ == "__main__":
    run()
