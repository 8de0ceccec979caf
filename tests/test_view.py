"""The interactive viewer's robot and loop, without a window."""

import contextlib
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from acting import Swaying

from cassie_mjx import cli, view
from cassie_mjx.agents import make
from cassie_mjx.evaluation import viewer
from cassie_mjx.evaluation.film import film
from cassie_mjx.evaluation.trial import Trial
from cassie_mjx.evaluation.viewer import Live
from cassie_mjx.robot import cassie
from cassie_mjx.robot.ground import Terrain
from cassie_mjx.view import ViewConfig


class _Window:
    """What `view.run` needs of MuJoCo's viewer: it lives for some syncs, and pushes the pelvis sideways."""

    def __init__(self, live, syncs, push=0.0):
        self.live, self.syncs, self.push = live, syncs, push
        self.texts, self.heights, self.times = [], [], []

    def is_running(self):
        return self.syncs > 0

    def lock(self):
        return contextlib.nullcontext()

    def set_texts(self, texts):
        self.texts.append(texts)

    def sync(self):
        self.syncs -= 1
        self.heights.append(self.live.data.qpos[2])
        self.times.append(self.live.data.time)
        self.live.data.xfrc_applied[cassie.PELVIS_BODY, 1] = self.push


def window_of(live, syncs, push=0.0) -> Any:
    """The window, typed as any."""
    return _Window(live, syncs, push)


@pytest.fixture
def clock(monkeypatch):
    """A clock that sleep alone moves on."""
    clock = SimpleNamespace(now=100.0)

    def sleep(seconds):
        assert seconds >= 0
        clock.now += seconds

    monkeypatch.setattr(viewer, "time", SimpleNamespace(perf_counter=lambda: clock.now, sleep=sleep))
    return clock


@pytest.mark.parametrize(
    ("period_s", "terrain", "kd_scale"), [(0.032, 0.0, 1.0), (0.002, 0.0, 1.0), (0.032, 0.05, 1.0), (0.032, 0.0, 0.3)]
)
def test_the_robot_steps_as_in_the_physics_of_the_sweeps(period_s, terrain, kd_scale):
    """Half a second on the model with all its visuals, in one MjData, against NativePhysics on the bare model."""
    agent = Swaying(period_s, kd_scale=kd_scale)
    hills = Terrain("sine", terrain)
    live = Live(agent, hills)
    for shot in film(agent, Trial(0, 0.5, terrain=hills), fps=100):
        np.testing.assert_array_equal(live.data.qpos, shot.qpos)
        live.advance(20)


def test_the_loop_keeps_real_time_and_says_so(clock):
    live = Live(Swaying())
    window = window_of(live, 50)
    viewer.keep_showing(window, live)
    np.testing.assert_allclose(live.data.time, 50 * 0.016)
    np.testing.assert_allclose(clock.now, 100 + 50 * 0.016)
    assert window.texts[-1][2:] == ("time\nspeed", f"0.8 s\n{(live.data.qpos[0] - 0.0) / 0.8:.2f} m/s")


def test_the_mouse_moves_the_robot(clock):
    still, pushed = Live(Swaying()), Live(Swaying())
    viewer.keep_showing(window_of(still, 20), still)
    viewer.keep_showing(window_of(pushed, 20, push=60.0), pushed)
    assert pushed.data.qpos[1] > still.data.qpos[1] + 0.01


def test_a_fallen_robot_starts_anew_after_a_second(clock):
    live = Live(Swaying(hold=0.0))
    start = live.data.qpos.copy()
    window = window_of(live, 200)
    viewer.keep_showing(window, live)
    fell, again = np.argmax(np.array(window.heights) < 0.6), np.argmin(np.diff(window.times)) + 1
    np.testing.assert_allclose(0.016 * (again - fell), 1.0, atol=0.017)
    live.restart()
    np.testing.assert_array_equal(live.data.qpos, start)
    assert not live.fallen
    assert not live.data.xfrc_applied.any()


def test_the_window_follows_the_pelvis_and_has_it_selected(monkeypatch, clock):
    opened = []

    def launch(model, data, **how):
        live = SimpleNamespace(data=data)
        window = window_of(live, 3)
        window.cam, window.perturb, window.opt = mujoco.MjvCamera(), mujoco.MjvPerturb(), mujoco.MjvOption()
        opened.append(window)
        return contextlib.nullcontext(window)

    monkeypatch.setattr(view, "check_screen", lambda: None)
    monkeypatch.setattr(view.mujoco.viewer, "launch_passive", launch)
    asked = []
    monkeypatch.setattr(make, "make_agent", lambda *names: asked.append(names) or Swaying())
    view.main(ViewConfig(policy="any", speed="2.5x"))
    (window,) = opened
    assert asked == [("any", "2.5x", None)]
    assert window.cam.type == mujoco.mjtCamera.mjCAMERA_TRACKING
    assert window.cam.trackbodyid == window.perturb.select == cassie.PELVIS_BODY
    assert window.opt.flags[mujoco.mjtVisFlag.mjVIS_PERTFORCE]
    assert not window.is_running()


def test_without_a_screen_there_is_one_sentence(monkeypatch):
    monkeypatch.setattr(viewer.glfw, "init", lambda: False)
    monkeypatch.setattr(view.sys, "platform", "linux")
    with pytest.raises(ValueError, match="needs a screen, and there is none here; python -m cassie_mjx.render films"):
        view.main(ViewConfig())


def test_a_terrain_below_zero_is_refused():
    with pytest.raises(ValueError, match=r"terrain=-0\.1 must have a level from 0 to 1, as in sine:0\.5\."):
        cli.parse(ViewConfig, ["terrain=-0.1"])
