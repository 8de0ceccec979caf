"""The picture of the robot in the guide: `python -m experiments.portrait out=docs/cassie.png`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar

import mujoco

from cassie_mjx import cli
from cassie_mjx.configuration.values import Checked, Range
from cassie_mjx.motion.files import load_motion
from cassie_mjx.robot.drawing import CAMERAS, load_scene, open_renderer
from experiments import pictures


@dataclass(frozen=True)
class PortraitConfig(Checked):
    """What to draw."""

    CHOICES: ClassVar[Mapping[str, Sequence[str]]] = {"camera": CAMERAS}

    out: str = "cassie.png"
    """Picture file, .png."""
    overwrite: bool = False
    """Whether to replace a file that is no picture of ours."""
    camera: str = "three-quarter"
    """A camera of the robot: "side", "front" or "three-quarter"."""
    sample: Annotated[int, Range(0, 21)] = 5
    """Sample of the reference stride; 5 is mid-swing."""
    width: Annotated[int, Range(16, 4096)] = 960
    """Pixels."""
    height: Annotated[int, Range(16, 4096)] = 720
    """Pixels."""


def main(config: PortraitConfig) -> None:
    """Render one pose of the reference motion."""
    out = pictures.check(config.out, config.overwrite)
    scene = load_scene()
    data = mujoco.MjData(scene)
    data.qpos[:] = load_motion("walk").qpos[config.sample]
    mujoco.mj_forward(scene, data)
    with open_renderer(scene, config.width, config.height) as renderer:
        renderer.update_scene(data, camera=config.camera)
        pixels = renderer.render()
    pictures.save_image(config.out, out, pixels)


if __name__ == "__main__":
    cli.run(main, PortraitConfig)
