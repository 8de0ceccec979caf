"""A walk as a video: `python -m cassie_mjx.render policy=1x out=walk.mp4`.

What is filmed is a trial as `cassie_mjx.evaluate` measures it: MuJoCo C at 2 kHz, from steady walking.
"""

import os
import subprocess
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

import imageio_ffmpeg
import mujoco
import numpy as np

from cassie_mjx import cli
from cassie_mjx.evaluation.film import Shot
from cassie_mjx.files.atomic import replacing
from cassie_mjx.robot import cassie
from cassie_mjx.robot.drawing import place
from cassie_mjx.robot.ground import Ground

# A push of 100 N is an arrow of 0.3 m; its head ends at the pelvis' skin, not at the centre of mass.
ARROW_M_PER_N, ARROW_RADIUS_M, ARROW_GAP_M = 0.003, 0.02, 0.14
ARROW_RGBA = np.array([0.85, 0.1, 0.1, 1.0], np.float32)

# How ffmpeg encodes. A GIF gets a palette of its own colours, and no dithering, which would flicker.
ENCODINGS = {
    ".mp4": ["-c:v", "libx264", "-crf", "18", "-pix_fmt", "yuv420p", "-movflags", "+faststart", "-f", "mp4"],
    ".gif": ["-vf", "split[a][b];[a]palettegen[p];[b][p]paletteuse=dither=none", "-f", "gif"],
    ".webp": ["-c:v", "libwebp_anim", "-quality", "60", "-loop", "0", "-f", "webp"],
}
_MARK = b"made by cassie-mjx render"
FILM = cli.marked("a film of ours", _MARK)
"""Videos that `write_video` has made."""
# Browsers slow a GIF down whose frames last less than 0.02 s.
FASTEST_GIF = 50


def draw_frames(
    renderer: mujoco.Renderer, shots: Iterable[Shot], camera: str, ground: Ground | None = None
) -> Iterator[np.ndarray]:
    """Frames [height, width, 3], uint8, of the shots; a push is an arrow whose head is at the pelvis.

    Args:
      renderer: of the scene of that ground.
      shots: what to draw.
      camera: one of `CAMERAS`.
      ground: the robot's, flat unless given.
    """
    data = mujoco.MjData(renderer.model)
    for shot in shots:
        place(renderer, data, shot.qpos, camera, ground)
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
      OSError: ffmpeg failed, or the file cannot be written; the sentence names it.
    """
    source = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {fps} -i -".split()
    comment = ["-metadata", f"comment={_MARK.decode()}"]
    with replacing(cli.check_writable(str(path))) as partial:
        command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-y", *source, *comment, *ENCODINGS[path.suffix]]
        with suppress(BrokenPipeError), subprocess.Popen([*command, str(partial)], stdin=subprocess.PIPE) as ffmpeg:
            assert ffmpeg.stdin
            for frame in frames:
                ffmpeg.stdin.write(frame)
        if ffmpeg.returncode:
            raise OSError(f"ffmpeg failed with status {ffmpeg.returncode}")
        if path.suffix in _COMMENTS:
            _COMMENTS[path.suffix](partial)


def _add_gif_comment(path: Path) -> None:
    """Put our mark before the byte that ends a GIF, for ffmpeg writes no comment into one."""
    with path.open("r+b") as file:
        file.seek(-1, os.SEEK_END)
        file.write(b"\x21\xfe" + bytes([len(_MARK)]) + _MARK + b"\x00;")


def _add_webp_comment(path: Path) -> None:
    """Put our mark into a chunk at the end of a WebP file, where readers ignore what they do not know."""
    with path.open("r+b") as file:
        file.seek(0, os.SEEK_END)
        file.write(b"NOTE" + len(_MARK).to_bytes(4, "little") + _MARK + b"\0" * (len(_MARK) % 2))
        # A RIFF file has its length, without these eight bytes, after its first four.
        length = file.tell() - 8
        file.seek(4)
        file.write(length.to_bytes(4, "little"))


_COMMENTS = {".gif": _add_gif_comment, ".webp": _add_webp_comment}
