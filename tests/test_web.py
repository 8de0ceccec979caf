"""The live view in a browser: a real one, without a screen, presses keys and clicks."""

import socket
import threading
import time

import numpy as np
import pytest

pytest.importorskip("mjviser", reason="the extra web")

from browser import CHROMIUM, Browser

from cassie_mjx import cli
from cassie_mjx.agents.make import make_agent
from cassie_mjx.evaluation.track import velocities
from cassie_mjx.evaluation.viewer import SYNC_S, Live, steerable
from cassie_mjx.evaluation.web import COMMANDS, WebView
from cassie_mjx.robot.ground import FLAT, Terrain
from cassie_mjx.view import ViewConfig, main


@pytest.fixture
def port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def make(policy, terrain):
    return Live(steerable(make_agent(policy)), terrain)


@pytest.fixture
def view(port):
    made = WebView(make, ["any", "1x", "controller:stiff"], FLAT, "127.0.0.1", port)
    yield made
    made.close()


def test_every_command_does_what_its_key_does(view):
    for label in COMMANDS:
        view._press(label)
    assert list(view.live.keys) == [key for _, key in COMMANDS.values()]
    view.live.keys.clear()
    view._stand()
    view.live.answer_keys()
    assert view.live.target == (0, 0, 0, 1)
    view._steer(2, 0.5)
    assert view.live.target == (0, 0, 0.5, 0)
    before = view.live
    view._begin("1x", Terrain("sine", 0.05))
    assert view.live is not before
    assert (view.live.agent.name, view.live.terrain) == ("1x", Terrain("sine", 0.05))
    view._begin("nobody", FLAT)
    assert "nobody" in view._said.content
    assert view.live.agent.name == "1x", "it walks on as before"
    view.run(0.5)
    assert len(view._plotted) > 0


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
def test_a_browser_drives_the_robot(view, port, tmp_path):
    over = threading.Event()

    def walk():
        while not over.is_set():
            view.run(0.2)

    walking = threading.Thread(target=walk)
    walking.start()
    browser = Browser(f"http://127.0.0.1:{port}", tmp_path / "browser")
    try:
        until(lambda: "All visitors drive this one robot." in browser.text())
        own = speed(view)
        assert own[0] == pytest.approx(0.71, abs=0.1)
        for _ in range(5):
            browser.press("ArrowUp", 38)
        browser.press("ArrowLeft", 37)
        until(lambda: view.live.target == (pytest.approx(1.2), 0, pytest.approx(0.1), 0))
        until(lambda: speed(view)[0] > own[0] + 0.25)
        browser.value("[...document.querySelectorAll('button')].find(b => b.innerText == 'stop').click()")
        until(lambda: view.live.target == (0, 0, 0, 0))
        browser.screenshot(tmp_path / "view.png")
        assert (tmp_path / "view.png").stat().st_size > 50_000
    finally:
        over.set()
        browser.close()
        walking.join()


def speed(view):
    return velocities(np.array([list(view.live.places)]), SYNC_S)[0].mean(axis=0)


def until(true, seconds=60):
    last = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < last
        time.sleep(0.2)


def test_a_port_in_use_is_refused(port):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", port))
        taken.listen()
        with pytest.raises(
            ValueError, match=rf"port={port} at host=127.0.0.1 cannot be used \(Address already in use\)"
        ):
            main(cli.parse(ViewConfig, ["policy=any", "web=true", f"port={port}"]))


def test_without_viser_one_sentence_says_what_to_install(monkeypatch):
    import sys

    monkeypatch.delitem(sys.modules, "cassie_mjx.evaluation.web")
    monkeypatch.setitem(sys.modules, "mjviser", None)
    with pytest.raises(ValueError, match=r"web=true needs viser and mjviser .*pip install 'cassie-mjx\[web\]'"):
        main(cli.parse(ViewConfig, ["policy=any", "web=true"]))
