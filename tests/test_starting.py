"""Ctrl-C while a command starts and runs, and an environment in which something does not work."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from cassie_mjx import starting
from cassie_mjx.cli import keep_compiled_programs
from cassie_mjx.cli.ending import one_sentence, plain_words

ROOT = Path(__file__).parents[1]


@pytest.fixture
def process(monkeypatch):
    """A process that has just begun, with drawing asked for."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    monkeypatch.setattr(starting, "_mujoco_gl", [])
    monkeypatch.setenv("MUJOCO_GL", "osmesa")

    def begin(package, argv, orig_argv):
        monkeypatch.setattr(sys, "argv", argv)
        monkeypatch.setattr(sys, "orig_argv", orig_argv)
        starting.begin(package)
        return signal.getsignal(signal.SIGINT) is starting.end_at_once, os.environ.get("MUJOCO_GL")

    yield begin
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(
    ("package", "argv", "orig_argv"),
    [
        ("cassie_mjx", ["-m"], ["python", "-m", "cassie_mjx.train", "seed=1"]),
        ("cassie_mjx", ["-m"], ["python", "-mcassie_mjx.train"]),
        ("experiments", ["-m"], ["python", "-X", "dev", "-m", "experiments.contacts"]),
        ("cassie_mjx", ["/usr/bin/cassie-mjx", "train"], ["python", "/usr/bin/cassie-mjx", "train"]),
    ],
)
def test_a_command_ends_by_ctrl_c_and_imports_mujoco_whatever_is_to_draw(process, package, argv, orig_argv):
    assert process(package, argv, orig_argv) == (True, None)
    assert starting.mujoco_gl() == "osmesa"


@pytest.mark.parametrize(
    ("argv", "orig_argv"),
    [
        (["app.py"], ["python", "app.py", "cassie_mjx.train"]),
        (["-m"], ["python", "-m", "app.walk"]),
        (["/a/cassie_mjx_like.py"], ["python", "-m", "cassie_mjx_like"]),
        ([""], ["python"]),
    ],
)
def test_a_library_changes_nothing(process, argv, orig_argv):
    assert process("cassie_mjx", argv, orig_argv) == (False, "osmesa")
    assert starting.mujoco_gl() == "osmesa"


def test_a_signal_that_is_ignored_stays_so(process):
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    assert process("cassie_mjx", ["-m"], ["python", "-m", "cassie_mjx.train"])[0] is False


@pytest.mark.timeout(60)
@pytest.mark.parametrize("module", ["cassie_mjx.train", "experiments.contacts"])
def test_ctrl_c_during_the_imports_ends_with_one_word(module, tmp_path):
    command = [sys.executable, "-X", "importtime", "-m", module]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=tmp_path, env=environment) as started:
        assert started.stderr
        # Python names each module as it is there; ours comes before what takes time.
        next(line for line in started.stderr if "| numpy" in line or "|   numpy" in line or "numpy." in line)
        started.send_signal(signal.SIGINT)
        rest = [line for line in started.stderr if not line.startswith("import time:")]
    assert (started.returncode, rest) == (130, ["Interrupted.\n"])


def test_ctrl_c_that_a_destructor_loses_comes_again(capsys):
    class Lost:
        def __del__(self):
            raise KeyboardInterrupt

    def wait():
        Lost()
        for _ in range(100):
            time.sleep(0.1)

    with pytest.raises(SystemExit) as ended, one_sentence():
        wait()
    assert ended.value.code == 130
    assert capsys.readouterr().err == "Interrupted.\n"


def no_device():
    raise RuntimeError("Unable to initialize backend 'cuda'")


def test_devices_that_are_not_there_are_named_with_their_variable(monkeypatch):
    monkeypatch.setitem(sys.modules, "jax", SimpleNamespace(devices=no_device))
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    with (
        pytest.raises(ValueError, match="^JAX_PLATFORMS=cuda names no .*; JAX_PLATFORMS=cpu works"),
        plain_words(),
    ):
        raise AssertionError
    monkeypatch.delenv("JAX_PLATFORMS")
    with pytest.raises(AssertionError), plain_words():
        raise AssertionError


@pytest.mark.parametrize(
    "error", [MemoryError("Unable to allocate 38. GiB"), RuntimeError("RESOURCE_EXHAUSTED: Out of memory\nmore")]
)
def test_memory_that_is_not_enough_is_a_sentence(error):
    with pytest.raises(ValueError, match=r"^The memory is not enough: .*\. Ask for less at a time\.$"), plain_words():
        raise error


def test_without_a_home_nothing_is_kept(monkeypatch, tmp_path):
    def nowhere():
        raise RuntimeError("Could not determine home directory.")

    asked = []
    config = SimpleNamespace(jax_compilation_cache_dir=None, update=lambda *what: asked.append(what))
    monkeypatch.setitem(sys.modules, "jax", SimpleNamespace(config=config))
    (tmp_path / "file").touch()
    for home in (nowhere, lambda: tmp_path / "file"):
        monkeypatch.setattr(Path, "home", home)
        keep_compiled_programs()
    assert not asked
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    keep_compiled_programs()
    assert asked == [("jax_compilation_cache_dir", str(tmp_path / ".cache" / "cassie-mjx"))]
