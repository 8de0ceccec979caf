"""Drawing the robot without a screen: by EGL, or by OSMesa where EGL does not work."""

import functools
import importlib
import os
import subprocess
import sys

import mujoco
import numpy as np
from mujoco.rendering.classic import gl_context

from cassie_mjx import starting
from cassie_mjx.robot.ground import FLAT, Ground, height_below, set_terrain
from cassie_mjx.robot.model import xml_path

CAMERAS = ("three-quarter", "side", "front")
# A camera follows a falling robot down, but not into the ground.
LOWEST_CAMERA_M = 0.25

BACKENDS = ("egl", "osmesa")
_PROBE = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 8, 8).render()"


def load_scene(ground: Ground | None = None) -> mujoco.MjModel:
    """A scene with all that is for the eyes, on one robot's ground, flat unless given.

    Its physics is that of `ModelConfig()`.
    """
    ground = FLAT.ground if ground is None else ground
    scene = mujoco.MjModel.from_xml_path(str(xml_path(ground.scene)))
    if scene.nhfield:
        set_terrain(scene, ground)
    return scene


@functools.cache
def choose_backend() -> None:
    """Have MuJoCo draw without a screen: as MUJOCO_GL says or, on Linux, by EGL or OSMesa, whichever works first.

    Raises:
      ValueError: it cannot draw.
    """
    chosen = starting.mujoco_gl()
    if not chosen and sys.platform != "linux":
        return
    working = chosen if chosen and _draws(chosen) else next(filter(_draws, BACKENDS), None)
    if chosen and working not in (None, chosen):
        raise ValueError(f"MUJOCO_GL={chosen} does not work here; MUJOCO_GL={working} does, or unset it.")
    if not working:
        raise ValueError(
            "Drawing needs EGL or OSMesa, and neither works here; install libegl1 and libgl1-mesa-dri, or libosmesa6 "
            "(so named in Debian and Ubuntu)."
        )
    os.environ["MUJOCO_GL"] = working
    importlib.reload(gl_context)


def _draws(backend: str) -> bool:
    """Whether MuJoCo can draw by it, tried in a process of its own: PyOpenGL keeps the first, even one that fails."""
    environment = {**os.environ, "MUJOCO_GL": backend}
    probe = subprocess.run([sys.executable, "-c", _PROBE], env=environment, capture_output=True, check=False)
    return probe.returncode == 0


def open_renderer(scene: mujoco.MjModel, width: int, height: int) -> mujoco.Renderer:
    """A renderer of frames [height, width, 3], uint8, that needs no screen. Raises ValueError where none can draw."""
    choose_backend()
    scene.vis.global_.offwidth, scene.vis.global_.offheight = width, height
    return mujoco.Renderer(scene, height, width)


def place(
    renderer: mujoco.Renderer, data: mujoco.MjData, qpos: np.ndarray, camera: str, ground: Ground | None = None
) -> None:
    """Put the robot into the scene, for `renderer.render()` to draw.

    Args:
      renderer: of the scene of that ground.
      data: of the same scene.
      qpos: the robot's, [35].
      camera: one of `CAMERAS`.
      ground: the robot's, flat unless given.
    """
    data.qpos[:] = qpos
    mujoco.mj_forward(renderer.model, data)
    x, y, _ = data.cam_xpos.T
    lowest = height_below(FLAT.ground if ground is None else ground, x, y) + LOWEST_CAMERA_M
    data.cam_xpos[:, 2] = np.maximum(data.cam_xpos[:, 2], lowest)
    renderer.update_scene(data, camera)
