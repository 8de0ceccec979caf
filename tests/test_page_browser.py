"""The page in a browser: built, opened, driven by keys, and what it says where it cannot run."""

import functools
import http.server
import json
import os
import shutil
import subprocess
import threading
import time
from pathlib import Path

import pytest
from browser import CHROMIUM, Browser

from cassie_mjx import export
from cassie_mjx.export import ExportConfig
from cassie_mjx.physics.native import cores

PAGE = Path(__file__).parents[1] / "page"
NODE = shutil.which("node")
LARGEST_MB = 20
KEYS = {"ArrowUp": 38, "ArrowDown": 40, "ArrowLeft": 37, "ArrowRight": 39, "6": 54, "7": 55, "8": 56, "9": 57, " ": 32}

pytestmark = [
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here"),
    pytest.mark.skipif(NODE is None or not (PAGE / "node_modules").is_dir(), reason="no npm packages here (make site)"),
]


@pytest.fixture(scope="module")
def policies(tmp_path_factory):
    folder = tmp_path_factory.mktemp("policies")
    for name in ("joystick", "1x"):
        export.main(ExportConfig(policy=name, web=str(folder)))
    return folder


@pytest.fixture(scope="module")
def built(policies, tmp_path_factory):
    """The folder of the page."""
    out = tmp_path_factory.mktemp("drive")
    assert NODE
    subprocess.run([NODE, str(PAGE / "build.mjs"), str(policies), str(out)], check=True)
    return out


@pytest.fixture
def served(built):
    """The page's address at a plain static server."""
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=built)
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/index.html"
    server.shutdown()


@pytest.fixture
def opened(tmp_path):
    """Opens pages, and closes them."""
    browsers = []

    def at(url):
        browsers.append(Browser(url, tmp_path / f"browser{len(browsers)}"))
        return browsers[-1]

    yield at
    for browser in browsers:
        browser.close()


def said(browser, name):
    return browser.value(f"document.getElementById('{name}').textContent")


def seconds(browser):
    """Time that the robot has walked for, s; 0 before it does."""
    text = said(browser, "time") or ""
    return float(text.removesuffix(" s")) if text.endswith(" s") else 0.0


def until(true, longest_s=60):
    last = time.monotonic() + longest_s
    while not true():
        assert time.monotonic() < last
        time.sleep(0.1)


def press(browser, key, times=1):
    for _ in range(times):
        browser.press(key, KEYS[key])


def choose(browser, name, value):
    """Take one of the values of a chooser."""
    chooser = f"document.getElementById('{name}')"
    browser.value(f"{chooser}.value = '{value}'; {chooser}.dispatchEvent(new Event('change'))")


def open_policy(browser, file):
    """Choose a file of one's own."""
    root = browser.call("DOM.getDocument")["root"]["nodeId"]
    node = browser.call("DOM.querySelector", nodeId=root, selector="#file")["nodeId"]
    browser.call("DOM.setFileInputFiles", nodeId=node, files=[str(file)])


def test_it_is_small_and_walks_from_a_file(built, opened):
    assert sum(file.stat().st_size for file in built.iterdir()) < LARGEST_MB * 1e6
    browser = opened((built / "index.html").as_uri())
    until(lambda: seconds(browser) > 1)
    press(browser, "ArrowUp", 5)
    press(browser, "ArrowLeft", 3)
    until(lambda: said(browser, "told") == "1.20 m/s ahead, 0.00 m/s left, 0.30 rad/s left")
    asked = browser.value("JSON.stringify(performance.getEntriesByType('resource').map(each => each.name))")
    assert {name.partition(":")[0] for name in json.loads(asked)} <= {"file", "blob"}
    assert said(browser, "falls") == "0"


def test_a_policy_of_another_version_gets_one_sentence(policies, tmp_path, served, opened):
    other, damaged = tmp_path / "other.json", tmp_path / "damaged.json"
    content = json.loads((policies / "1x.json").read_text())
    other.write_text(json.dumps(content | {"version": 99}))
    damaged.write_text(
        json.dumps(content | {"network": content["network"] | {"layers": content["network"]["layers"][1:]}})
    )
    browser = opened(served)
    until(lambda: seconds(browser) > 0.5)
    for file, sentence in (
        (other, "This policy's file is of version 99, and this page reads version 3 alone; export it anew."),
        (damaged, "This policy's file is damaged (the sizes of its network do not fit together); export it anew."),
        (Path(__file__), "This file is no policy for this page; export one with web=FOLDER."),
    ):
        open_policy(browser, file)
        until(lambda sentence=sentence: said(browser, "says") == sentence)
    before = seconds(browser)
    until(lambda: seconds(browser) > before)
    assert said(browser, "falls") == "0", "it walks on as before"


def test_a_policy_of_ones_own_stays_on_another_ground_even_while_paused(policies, served, opened):
    browser = opened(served)
    until(lambda: seconds(browser) > 0.5)
    open_policy(browser, policies / "1x.json")
    until(lambda: (said(browser, "learned") or "").startswith("1x ") and seconds(browser) > 0.5)
    choose(browser, "pace", "paused")
    choose(browser, "ground", "hills")
    until(lambda: said(browser, "time") == "0.0 s")
    assert (said(browser, "learned") or "").startswith("1x ")


@pytest.mark.parametrize(
    ("taken", "sentence"),
    [
        ("delete window.WebAssembly", "This browser has no WebAssembly, in which the physics of this page runs"),
        ("HTMLCanvasElement.prototype.getContext = () => null", "This browser has no WebGL 2, which draws the robot"),
        ("delete window.DecompressionStream", "This browser is older than 2023"),
    ],
)
def test_a_browser_that_lacks_something_gets_one_sentence(served, opened, taken, sentence):
    browser = opened("about:blank")
    browser.call("Page.enable")
    browser.call("Page.addScriptToEvaluateOnNewDocument", source=taken)
    browser.call("Page.navigate", url=served)
    until(lambda: (said(browser, "says") or "").startswith(sentence))


@pytest.mark.slow
def test_a_minute_of_driving_with_five_pushes(served, opened, tmp_path):
    others = os.getloadavg()[0] / cores()
    browser = opened(served)
    until(lambda: seconds(browser) > 1)
    rates = [
        drive(
            browser, {2: "ArrowUp", 4: "ArrowUp", 6: "6", 9: "ArrowLeft", 11: "ArrowLeft", 14: "8", 18: "ArrowRight"}
        ),
        hills(browser, {3: "ArrowUp", 6: "6", 10: "ArrowDown", 14: "9", 18: "ArrowLeft", 22: "7", 25: "ArrowRight"}),
    ]
    browser.screenshot(tmp_path / "hills.png")
    assert (tmp_path / "hills.png").stat().st_size > 50_000
    assert said(browser, "falls") == "0"
    if others > 1.5:
        pytest.skip(f"no fall, but others use these cores {others:.1f} times over: real time x {min(rates):.2f}")
    assert min(rates) > 0.98


def drive(browser, keys, longest_s=30):
    """Press keys at times, s, and say how fast the robot's time went by."""
    began, first = time.monotonic(), seconds(browser)
    for when, key in keys.items():
        time.sleep(max(began + when - time.monotonic(), 0))
        press(browser, key)
    time.sleep(max(began + longest_s - time.monotonic(), 0))
    return (seconds(browser) - first) / (time.monotonic() - began)


def hills(browser, keys):
    choose(browser, "ground", "hills")
    until(lambda: 0.5 < seconds(browser) < 5)
    return drive(browser, keys)
