"""Pictures and videos, without a screen."""

import os
import subprocess
from types import SimpleNamespace

import imageio.v3 as imageio
import imageio_ffmpeg
import numpy as np
import pytest
from acting import Swaying
from PIL import Image, ImageSequence

from cassie_mjx import cli, render
from cassie_mjx.agents import make
from cassie_mjx.evaluation.draw import draw_frames, write_video
from cassie_mjx.evaluation.film import Shot
from cassie_mjx.render import RenderConfig
from cassie_mjx.robot import drawing as drawing_module
from cassie_mjx.robot.ground import FLAT, Terrain

WIDTH, HEIGHT = 192, 128
FLOOR_PERIOD_M = 1.0


@pytest.fixture(scope="module")
def drawing():
    """Skip where there is no backend to draw with."""
    try:
        drawing_module.choose_backend()
    except ValueError as error:
        pytest.skip(str(error))


def picture(qpos, camera="three-quarter", push=(0.0, 0.0, 0.0), terrain=FLAT):
    shot = Shot(0.0, qpos, np.array(push), None)
    with drawing_module.open_renderer(drawing_module.load_scene(terrain.ground), WIDTH, HEIGHT) as renderer:
        return next(draw_frames(renderer, [shot], camera, terrain.ground)).astype(int)


def differing(a, b):
    """Share of pixels that differ clearly."""
    return float((np.abs(a - b).max(axis=-1) > 12).mean())


@pytest.mark.parametrize("camera", render.CAMERAS)
def test_the_camera_follows(drawing, standing_qpos, camera):
    along = standing_qpos.copy()
    along[0] += 20 * FLOOR_PERIOD_M
    here, there = picture(standing_qpos, camera), picture(along, camera)
    assert here.shape == (HEIGHT, WIDTH, 3)
    assert here.std() > 10
    assert differing(here, there) < 0.005
    half = standing_qpos.copy()
    half[0] += FLOOR_PERIOD_M / 2
    assert differing(here, picture(half, camera)) > 0.1


@pytest.mark.parametrize("camera", render.CAMERAS)
def test_the_camera_stays_above_the_ground(drawing, standing_qpos, camera):
    """Over the robot there is sky, also when it lies on the ground; seen from below, the sky is under it."""
    lying = standing_qpos.copy()
    lying[2] -= 0.8
    image = picture(lying, camera)
    blue = image[..., 2] - image[..., 0]
    assert blue[0].min() > 30 > blue[-1].max()


def test_the_views_differ(drawing, standing_qpos):
    side, front, oblique = (picture(standing_qpos, camera) for camera in ("side", "front", "three-quarter"))
    assert min(differing(side, front), differing(front, oblique), differing(oblique, side)) > 0.05


def test_a_push_is_a_red_arrow_on_the_side_that_it_comes_from(drawing, standing_qpos):
    def red(push):
        image = picture(standing_qpos, "side", push)
        return np.argwhere((image[..., 0] > 90) & (image[..., 1] < 60) & (image[..., 2] < 60))

    assert len(red((0.0, 0.0, 0.0))) == 0
    # The side camera looks along +y: +x is to the right, so a forward push comes from the left. The height of the
    # picture is 2 x 2.5 m x tan(33 deg / 2); the pelvis is 0.08 m before the middle.
    pixels_per_m = HEIGHT / (5 * np.tan(np.deg2rad(16.5)))
    for push, sign, length in ((120.0, -1, 0.36), (-120.0, 1, 0.36), (240.0, -1, 0.72)):
        columns = red((push, 0.0, 0.0))[:, 1] + 0.5 - WIDTH / 2
        behind = sign * (columns / pixels_per_m - 0.08)
        # The point of the arrow is too thin to be seen.
        np.testing.assert_allclose(behind.min(), 0.14, atol=0.08)
        np.testing.assert_allclose(behind.max(), 0.14 + length, atol=0.05)


def test_terrain_is_seen(drawing, standing_qpos):
    def horizon(h):
        """Rows of sky in the columns left and right of the robot."""
        qpos = standing_qpos.copy()
        qpos[0] = np.pi
        image = picture(qpos, "side", terrain=Terrain("sine", h))[:, np.r_[: WIDTH // 4, WIDTH * 3 // 4 : WIDTH]]
        return (image[..., 2] - image[..., 0] > 30).sum(axis=0)

    assert np.ptp(horizon(0.0)) <= 1
    assert np.ptp(horizon(0.1)) >= 3
    assert np.ptp(horizon(0.2)) >= np.ptp(horizon(0.1)) + 2


@pytest.mark.parametrize(
    ("suffix", "fps"), [("mp4", 25.0), ("mp4", 60.0), ("gif", 25.0), ("gif", 31.25), ("webp", 25.0), ("webp", 60.0)]
)
def test_videos_have_their_frames_and_duration(tmp_path, suffix, fps):
    greys = np.linspace(0, 250, 12).astype(np.uint8)
    frames = [np.full((32, 48, 3), grey, np.uint8) for grey in greys]
    path = tmp_path / f"a.{suffix}"
    write_video(path, frames, 48, 32, fps)
    if suffix == "mp4":
        video, seconds = imageio.imread(path, plugin="FFMPEG"), imageio_ffmpeg.count_frames_and_secs(path)[1]
    else:
        with Image.open(path) as film:
            assert film.info["loop"] == 0
            # A frame of a WebP has its duration once it is loaded.
            frames = [frame.copy() for frame in ImageSequence.Iterator(film)]
        video = np.stack([np.asarray(frame.convert("RGB")) for frame in frames])
        seconds = sum(frame.info["duration"] for frame in frames) / 1000
    assert video.shape == (12, 32, 48, 3)
    np.testing.assert_allclose(video.astype(int).mean(axis=(1, 2, 3)), greys, atol=6)
    # A GIF counts in hundredths of a second, WebP each frame in thousandths.
    assert seconds == pytest.approx(12 / fps, abs=0.011)
    assert list(tmp_path.iterdir()) == [path]


def test_a_failing_film_leaves_what_was_there(tmp_path):
    def frames():
        yield np.zeros((32, 48, 3), np.uint8)
        raise ValueError("the film tore")

    (tmp_path / "a.mp4").write_text("precious")
    with pytest.raises(ValueError, match="the film tore"):
        write_video(tmp_path / "a.mp4", frames(), 48, 32, 25.0)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("a.mp4", "precious")]


def test_a_film_goes_where_its_link_leads_in_the_format_of_its_name(tmp_path):
    (tmp_path / "store").mkdir()
    (tmp_path / "a.gif").symlink_to("store/b")
    write_video(tmp_path / "a.gif", 3 * [np.zeros((32, 48, 3), np.uint8)], 48, 32, 25.0)
    assert (tmp_path / "a.gif").is_symlink()
    assert (tmp_path / "store" / "b").read_bytes().startswith(b"GIF8")
    os.mkfifo(tmp_path / "b.gif")
    with pytest.raises(ValueError, match=r"b\.gif is not a regular file"):
        write_video(tmp_path / "b.gif", [], 48, 32, 25.0)
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["a.gif", "b", "b.gif", "store"]


def test_an_encoder_that_fails_is_noticed(tmp_path, monkeypatch):
    (tmp_path / "a.gif").write_text("precious")
    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", lambda: "false")
    with pytest.raises(OSError, match=r"a\.gif could not be written \(ffmpeg failed with status 1\); nothing"):
        write_video(tmp_path / "a.gif", 100 * [np.zeros((32, 48, 3), np.uint8)], 48, 32, 25.0)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("a.gif", "precious")]


@pytest.mark.parametrize(("hold", "end"), [(1.0, "swaying stayed up"), (0.0, "swaying fell after 0.")])
def test_the_command_says_how_it_went(drawing, tmp_path, monkeypatch, capsys, hold, end):
    asked = []
    monkeypatch.setattr(make, "make_agent", lambda *names: asked.append(names) or Swaying(hold=hold))
    out = tmp_path / "a.gif"
    arguments = [f"out={out}", "width=32", "height=32", "fps=10", "seconds=0.8", "push=20,0", "push_at=0.1"]
    render.main(cli.parse(RenderConfig, ["policy=blend:1x,2x", "schedule=ramp", *arguments]))
    assert asked == [("blend:1x,2x", None, "ramp", None)]
    assert end in " ".join(capsys.readouterr().err.split())
    assert len(imageio.imread(out, index=None)) == 8


@pytest.mark.parametrize(
    ("argument", "sentence"),
    [
        ("out=walk.avi", r"out=walk\.avi cannot be filmed; name a file that ends in \.mp4, \.gif, \.webp\."),
        ("out=walk", r"name a file that ends in \.mp4, \.gif, \.webp"),
        ("camera=top", "camera=top is not known; choose one of three-quarter, side, front"),
        ("seconds=0", r"seconds=0\.0 must be from 0\.01 to 3,600\."),
        ("seconds=1e-11", r"seconds=1e-11 must be from 0\.01 to 3,600\."),
        ("seconds=inf", "seconds=inf must be from"),
        ("push=10", r"push=10\.0 must be 2 values, with commas between\."),
        ("push=10,nan", "push=10.0,nan: each must be from -1,000 to 1,000"),
        ("push=1e300,0", "each must be from -1,000 to 1,000"),
        ("push_at=-1", "must be from 0 to 3,600"),
        ("terrain=-0.1", "terrain=-0.1 must have a level from 0 to 1, as in sine:0.5"),
        ("terrain=steps:9", "terrain=steps:9 must have a level from 0 to 0.5"),
        ("terrain=moon:0.1", "choose one of sine, slope, across, steps, rough, as in steps:0.1"),
        ("delay=1e9", "must be from 0 to 1,000"),
        ("delay=0.3", r"delay=0\.3 cannot be filmed; use a multiple of 0\.5 ms"),
        ("phase=2", "phase=2.0 must be from 0 to 1"),
        ("width=641", "width=641 cannot be filmed; use an even number"),
        ("height=8", "height=8 must be a whole number from 16 to 4,096"),
        ("fps=0", "must be from 1 to 1,000"),
    ],
)
def test_what_cannot_be_filmed_gets_one_sentence(argument, sentence):
    with pytest.raises(ValueError, match=sentence):
        cli.parse(RenderConfig, [argument])


def test_a_push_after_the_end_of_the_film_is_refused():
    for seconds, push_at in (("10", "20"), ("1", "2")):
        with pytest.raises(ValueError, match=rf"push_at={push_at}\.0 cannot be filmed; the film ends at {seconds} s\."):
            cli.parse(RenderConfig, ["push=0,50", f"push_at={push_at}", f"seconds={seconds}"])
    assert cli.parse(RenderConfig, ["seconds=1"]).push_at == 2, "which nobody asked for"


def test_a_gif_faster_than_browsers_show_it_is_refused():
    with pytest.raises(ValueError, match=r"fps=60\.0 cannot be filmed; a GIF has at most 50"):
        cli.parse(RenderConfig, ["out=a.gif", "fps=60"])


def test_an_unwritable_file_is_refused_before_the_walk(tmp_path):
    with pytest.raises(ValueError, match=r"missing/a\.mp4 cannot be written"):
        render.main(RenderConfig(out=str(tmp_path / "missing" / "a.mp4")))


@pytest.mark.parametrize(
    ("chosen", "sentence"),
    [
        (None, "neither works here; install libegl1 and libgl1-mesa-dri, or libosmesa6"),
        ("osmesa", "neither works here"),
    ],
)
def test_where_nothing_can_draw_the_packages_are_named(monkeypatch, chosen, sentence):
    tried = []

    def failing(command, env, **how):
        tried.append(env["MUJOCO_GL"])
        return SimpleNamespace(returncode=1)

    monkeypatch.setattr(drawing_module.sys, "platform", "linux")
    monkeypatch.setattr(subprocess, "run", failing)
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    if chosen:
        monkeypatch.setenv("MUJOCO_GL", chosen)
    with pytest.raises(ValueError, match=sentence):
        drawing_module.choose_backend.__wrapped__()
    assert tried == [*([chosen] if chosen else []), "egl", "osmesa"]


def test_what_draws_instead_is_named(monkeypatch):
    monkeypatch.setattr(drawing_module, "_draws", lambda backend: backend == "egl")
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    with pytest.raises(ValueError, match=r"^MUJOCO_GL=osmesa does not work here; MUJOCO_GL=egl does, or unset it\.$"):
        drawing_module.choose_backend.__wrapped__()
