"""A walk as a video: `python -m cassie_mjx.render policy=1x out=walk.mp4`.

What is filmed is a trial as `cassie_mjx.evaluate` measures it: MuJoCo C at 2 kHz, from steady walking. No screen is
needed: EGL draws, or OSMesa where EGL does not work.
"""

import functools
import importlib
import os
import subprocess
import sys
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

import imageio_ffmpeg
import mujoco
import numpy as np
from mujoco.rendering.classic import gl_context

from cassie_mjx import cli, starting
from cassie_mjx.evaluation.film import Shot
from cassie_mjx.robot import cassie
from cassie_mjx.robot.ground import set_terrain
from cassie_mjx.robot.model import xml_path

CAMERAS = ("three-quarter", "side", "front")
# A camera follows a falling robot down, but not into the ground.
LOWEST_CAMERA_M = 0.25
# A push of 100 N is an arrow of 0.3 m; its head ends at the pelvis' skin, not at the centre of mass.
ARROW_M_PER_N, ARROW_RADIUS_M, ARROW_GAP_M = 0.003, 0.02, 0.14
ARROW_RGBA = np.array([0.85, 0.1, 0.1, 1.0], np.float32)

# How ffmpeg encodes. A GIF gets a palette of its own colours, and no dithering, which would flicker.
ENCODINGS = {
    ".mp4": ["-c:v", "libx264", "-crf", "18", "-pix_fmt", "yuv420p", "-movflags", "+faststart", "-f", "mp4"],
    ".gif": ["-vf", "split[a][b];[a]palettegen[p];[b][p]paletteuse=dither=none", "-f", "gif"],
}
# Browsers slow a GIF down whose frames last less than 0.02 s.
FASTEST_GIF = 50

BACKENDS = ("egl", "osmesa")
_PROBE = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 8, 8).render()"


def load_scene(terrain: float = 0.0) -> mujoco.MjModel:
    """A scene with all that is for the eyes, on the terrain z = h sin x, m; its physics is that of `ModelConfig()`."""
    scene = mujoco.MjModel.from_xml_path(str(xml_path("terrain" if terrain else "flat")))
    if terrain:
        set_terrain(scene, terrain)
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


def draw_frames(
    renderer: mujoco.Renderer, shots: Iterable[Shot], camera: str, terrain: float = 0.0
) -> Iterator[np.ndarray]:
    """Frames [height, width, 3], uint8, of the shots; a push is an arrow whose head is at the pelvis.

    Args:
      renderer: of the scene of that terrain.
      shots: what to draw.
      camera: one of `CAMERAS`.
      terrain: height h of the terrain z = h sin x, m.
    """
    data = mujoco.MjData(renderer.model)
    for shot in shots:
        data.qpos[:] = shot.qpos
        mujoco.mj_forward(renderer.model, data)
        lowest = terrain * np.sin(data.cam_xpos[:, 0]) + LOWEST_CAMERA_M
        data.cam_xpos[:, 2] = np.maximum(data.cam_xpos[:, 2], lowest)
        renderer.update_scene(data, camera)
        if shot.push_w.any():
            _add_arrow(renderer.scene, data.xipos[cassie.PELVIS_BODY], shot.push_w)
        yield renderer.render()


def _add_arrow(scene: mujoco.MjvScene, pelvis: np.ndarray, push: np.ndarray) -> None:
    head = pelvis - ARROW_GAP_M * push / np.linalg.norm(push)
    tail = head - ARROW_M_PER_N * push
    arrow, zero = scene.geoms[scene.ngeom], np.zeros(3)
    mujoco.mjv_initGeom(arrow, mujoco.mjtGeom.mjGEOM_ARROW, zero, zero, np.eye(3).ravel(), ARROW_RGBA)
    # MuJoCo draws an arrow over the first half of its connector.
    mujoco.mjv_connector(arrow, mujoco.mjtGeom.mjGEOM_ARROW, ARROW_RADIUS_M, tail, 2 * head - tail)
    scene.ngeom += 1


def write_video(path: Path, frames: Iterable[np.ndarray], width: int, height: int, fps: float) -> None:
    """Write frames [height, width, 3], uint8, whole or not at all, in the format that the suffix of `path` names.

    Raises:
      ValueError: no regular file can be written there; see `cli.check_writable`.
      OSError: ffmpeg failed.
    """
    final = cli.check_writable(str(path))
    partial = final.with_name(final.name + ".partial")
    source = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {fps} -i -".split()
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-y", *source, *ENCODINGS[path.suffix], str(partial)]
    try:
        with suppress(BrokenPipeError), subprocess.Popen(command, stdin=subprocess.PIPE) as ffmpeg:
            assert ffmpeg.stdin
            for frame in frames:
                ffmpeg.stdin.write(frame)
        if ffmpeg.returncode:
            raise OSError(f"{path} has not been written: ffmpeg failed with status {ffmpeg.returncode}.")
        partial.replace(final)
    finally:
        partial.unlink(missing_ok=True)
