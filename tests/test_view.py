"""The interactive viewer's robot and loop, without a window."""

import contextlib
from types import SimpleNamespace
from typing import Any

import glfw
import mujoco
import numpy as np
import pytest
from acting import Swaying

from cassie_mjx import cli, view
from cassie_mjx.agents import make
from cassie_mjx.evaluation import keys, viewer
from cassie_mjx.evaluation.film import film
from cassie_mjx.evaluation.trial import Trial
from cassie_mjx.evaluation.viewer import Live
from cassie_mjx.motion.command import Command
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
    assert live.physics.init(live.data.qpos[None], live.data.qvel[None]).history.shape == (1, 0, 35 + 32 + 10)


def test_the_loop_keeps_real_time_and_says_so(clock):
    live = Live(Swaying())
    window = window_of(live, 50)
    viewer.keep_showing(window, live)
    np.testing.assert_allclose(live.data.time, 50 * 0.016)
    np.testing.assert_allclose(clock.now, 100 + 50 * 0.016)
    _, _, names, values = window.texts[-1]
    assert names == "time\nvelocity\n6, 7, 8, 9\nHome"
    assert values.splitlines()[0] == "0.8 s"
    assert values.splitlines()[1].startswith(f"{live.data.qpos[0] / 0.8:.2f} m/s ahead, ")


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
        live = SimpleNamespace(data=data, keys=how["key_callback"].__self__)
        window = window_of(live, 3)
        window.key_callback = how["key_callback"]
        window.cam, window.perturb, window.opt = mujoco.MjvCamera(), mujoco.MjvPerturb(), mujoco.MjvOption()
        opened.append(window)
        return contextlib.nullcontext(window)

    monkeypatch.setattr(view, "check_screen", lambda: None)
    monkeypatch.setattr(view.mujoco.viewer, "launch_passive", launch)
    asked = []
    monkeypatch.setattr(make, "make_agent", lambda *names: asked.append(names) or Swaying())
    view.main(ViewConfig(policy="any", speed="2.5x"))
    (window,) = opened
    assert asked == [("any", "2.5x", None, None)]
    assert window.key_callback == window.live.keys.append
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


@pytest.mark.parametrize(
    ("key", "before", "after"),
    [
        (glfw.KEY_UP, (0.7104, 0.2, 0.3), (0.8, 0.2, 0.3)),
        (glfw.KEY_DOWN, (0.0, 0.0, 0.0), (-0.1, 0.0, 0.0)),
        (glfw.KEY_UP, (2.8, 0.0, 0.0), (2.8, 0.0, 0.0)),
        (glfw.KEY_DOWN, (-0.7, 0.0, 0.0), (-0.7, 0.0, 0.0)),
        (glfw.KEY_LEFT, (0.7104, 0.0, 0.0), (0.7104, 0.0, 0.1)),
        (glfw.KEY_RIGHT, (1.0, 0.0, -0.8), (1.0, 0.0, -0.8)),
        (glfw.KEY_DELETE, (1.0, 0.1, 0.0), (1.0, 0.2, 0.0)),
        (glfw.KEY_PAGE_DOWN, (1.0, 0.0, 0.0), (1.0, -0.1, 0.0)),
        (glfw.KEY_END, (1.0, 0.2, 0.3), (0.0, 0.0, 0.0)),
        (glfw.KEY_END, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)),
        (glfw.KEY_END, (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0)),
        (glfw.KEY_LEFT, (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.1)),
    ],
)
def test_a_key_changes_one_component_within_its_range(key, before, after):
    assert keys.steer(key, Command(*before)) == Command(*after)


def test_no_key_is_one_that_the_viewer_has_a_use_for():
    taken = {row[2] for row in (*mujoco.mjVISSTRING, *mujoco.mjRNDSTRING)} | set("012345")
    assert not {ord(key) for key in taken if key} & {*keys.STEERING, *keys.PUSHES, keys.RESET}


@pytest.mark.parametrize(("key", "axis", "sign"), [(6, 0, 1), (7, 0, -1), (8, 1, 1), (9, 1, -1)])
def test_digits_push_for_a_fifth_of_a_second_and_home_starts_anew(clock, key, axis, sign):
    still, pushed = Live(Swaying()), Live(Swaying())
    # MuJoCo's force of the mouse stays as it is.
    pushed.data.xfrc_applied[cassie.PELVIS_BODY] = still.data.xfrc_applied[cassie.PELVIS_BODY] = [0, 0, 1, 0, 0, 0]
    pushed.keys.extend([ord(str(key)), ord("W")])
    pushed.answer_keys()
    for live in (still, pushed):
        live.advance(32)
    assert sign * (pushed.data.qvel[axis] - still.data.qvel[axis]) > 0.01
    np.testing.assert_array_equal(pushed.data.xfrc_applied, still.data.xfrc_applied)
    pushed.advance(400)
    assert pushed._push_steps == 0
    pushed.keys.append(keys.RESET)
    pushed.answer_keys()
    assert pushed.data.time == 0
    assert pushed.data.qvel[axis] == still._start.physics.qvel[0, axis]


def test_keys_steer_a_policy(clock):
    live = Live(viewer.steerable(make.make_agent("any")))
    own = live.command
    assert own is not None
    live.keys.append(glfw.KEY_F)
    live.answer_keys()
    live.advance(64)
    assert live.target is None
    live.keys.extend([glfw.KEY_LEFT, glfw.KEY_LEFT, glfw.KEY_UP])
    viewer.keep_showing(window := window_of(live, 30), live)
    forward = round(own.forward + 0.1, 1)
    assert live.target == (forward, 0, 0.2, 0)
    # 0.48 s at 0.44 m/s a second and 1.6 rad/s a second.
    assert live.command == pytest.approx((forward, 0, 0.2, 0), abs=1e-5)
    np.testing.assert_allclose(live._robots.carry.walk.path.heading, 0.2 * 0.44, atol=0.02)
    _, _, names, values = window.texts[-1]
    assert names.splitlines()[:4] == ["time", "target", "command", "velocity"]
    assert "Delete, Page Down" in names
    assert values.splitlines()[1] == f"{forward:.2f} m/s ahead, 0.00 m/s left, 0.20 rad/s left"
    live.restart()
    assert (live.target, live.command) == (None, own)


def test_what_takes_no_commands_is_watched_as_it_is():
    for name in ("0x", "controller:stiff"):
        agent = make.make_agent(name)
        assert viewer.steerable(agent) is agent
    commanded = make.make_agent("any", command="1")
    assert viewer.steerable(commanded) is commanded
