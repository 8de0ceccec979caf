"""What commands write: whose place it may take, and that nothing is lost when it cannot be written."""

import importlib
import json
import os
import signal
import subprocess
import sys
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from cassie_mjx import cli, evaluate, export
from cassie_mjx.agents.numpy_policy import FORMAT
from cassie_mjx.agents.shipped import shipped_policies
from cassie_mjx.cli.origin import is_ours
from cassie_mjx.evaluate import EvaluateConfig
from cassie_mjx.evaluation.draw import FILM, write_video
from cassie_mjx.evaluation.setup import SuiteResult
from cassie_mjx.evaluation.trial import Metric
from cassie_mjx.export import POLICY, ExportConfig
from cassie_mjx.files import archive, atomic
from cassie_mjx.reporting import page
from cassie_mjx.reporting.results import read
from cassie_mjx.training.interruption import Interruption
from experiments import pictures

ROOT = Path(__file__).parents[1]
EXPERIMENTS = sorted(path.stem for path in (ROOT / "experiments").glob("*.py"))


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def result(**provenance):
    return json.dumps({"rows": [], "provenance": cli.provenance() | provenance})


@pytest.mark.parametrize(
    "text",
    [
        "notes",
        "{}",
        "[]",
        '{"provenance": {}}',
        '{"provenance": []}',
        9999 * "[",
        result(command="python -m experiments.throughput out=a.json"),
        result(command="python -m 'experiments"),
        result(command=7),
        "\0\xff",
    ],
)
def test_what_is_no_result_of_the_command_is_not_replaced(tmp_path, text):
    out = tmp_path / "a.json"
    out.write_text(text)
    sentence = r"a\.json exists and is not a result of the same command; name another file, or .* overwrite=true\.$"
    with pytest.raises(ValueError, match=sentence):
        cli.check_output(str(out), cli.RESULT, overwrite=False)
    assert cli.check_output(str(out), cli.RESULT, overwrite=True) == out
    assert (names(tmp_path), out.read_text()) == (["a.json"], text)


def test_results_of_the_same_command_and_empty_files_are_replaced(tmp_path):
    out = tmp_path / "a.json"
    for text in ("", result(), result(command=cli.provenance()["command"] + " seed=7")):
        out.write_text(text)
        assert cli.check_output(str(out), cli.RESULT, overwrite=False) == out


def test_a_command_is_the_same_under_both_of_its_names(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["cassie-mjx evaluate", "policy=1x"])
    assert is_ours("python -m cassie_mjx.evaluate suite=map")
    assert is_ours("cassie-mjx evaluate")
    assert not is_ours("cassie-mjx report")
    monkeypatch.setattr(sys, "argv", [str(ROOT / "cassie_mjx" / "evaluate.py")])
    assert is_ours("cassie-mjx evaluate policy=2x")


def test_a_folder_where_no_file_can_be_made_is_refused_at_the_door():
    with pytest.raises(ValueError, match=r"^/proc/x\.json cannot be written \(.*\); name a file in an existing folder"):
        cli.check_writable("/proc/x.json")


def configurations():
    commands = [f"cassie_mjx.{name}" for name in ("evaluate", "export", "render", "report")]
    for name in [f"experiments.{name}" for name in EXPERIMENTS] + commands:
        module = importlib.import_module(name)
        for config in vars(module).values():
            if is_dataclass(config) and isinstance(config, type) and config.__module__ == name:
                yield Path(str(module.__file__)).read_text(), {field.name for field in fields(config)}


def test_everything_that_has_out_has_overwrite():
    found = [(source, keys) for source, keys in configurations() if "out" in keys]
    assert len(found) == 24
    for source, keys in found:
        assert "overwrite" in keys
        assert "config.overwrite)" in source
        assert "check_writable" not in source.replace("cli.check_writable(name)", "")


def test_a_full_disk_loses_no_result(tmp_path, monkeypatch, capsys):
    def full(*_):
        raise OSError(28, "No space left on device")

    (tmp_path / "a.json").write_text("old")
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=r"a\.json could not be written \(No space left on device\); nothing"):
        cli.write_result(tmp_path / "a.json", {"rows": [7]})
    assert json.loads(capsys.readouterr().out)["rows"] == [7]
    assert (names(tmp_path), (tmp_path / "a.json").read_text()) == (["a.json"], "old")


def test_a_name_with_markup_in_it_is_shown_to_the_letter(tmp_path, monkeypatch, capsys):
    odd = tmp_path / "[" / "red].npz"
    odd.parent.mkdir()
    odd.write_bytes(shipped_policies()["1x"].read_bytes())
    figure = Metric("speed_mps", 0.7, "m/s", 10)
    monkeypatch.setattr(evaluate, "SUITES", {"walk": lambda agent, setup: SuiteResult([figure])})
    evaluate.main(EvaluateConfig(policy=str(odd), suite="walk", out=str(tmp_path / "a.json")))
    assert "[/red].npz:walk" in "".join(capsys.readouterr().err.split())
    assert json.loads((tmp_path / "a.json").read_text())["rows"][0]["agent"] == str(odd)


def test_no_command_reads_markup():
    sources = [*(ROOT / "cassie_mjx").rglob("*.py"), *(ROOT / "experiments").glob("*.py")]
    assert [path.name for path in sources if "Console(stderr" in path.read_text()] == ["process.py"]


@pytest.mark.parametrize("suffix", ["mp4", "gif", "webp"])
def test_a_film_takes_the_place_of_a_film_of_ours_alone(tmp_path, suffix):
    out = tmp_path / f"a.{suffix}"
    for _ in range(2):
        assert cli.check_output(str(out), FILM, overwrite=False) == out
        write_video(out, 3 * [np.zeros((32, 48, 3), np.uint8)], 48, 32, 25.0)
    out.write_bytes(out.read_bytes().replace(b"cassie", b"nobody"))
    with pytest.raises(ValueError, match="exists and is not a film of ours"):
        cli.check_output(str(out), FILM, overwrite=False)


@pytest.mark.parametrize("suffix", ["png", "svg", "pdf"])
def test_a_picture_takes_the_place_of_a_picture_of_ours_alone(tmp_path, suffix):
    name = str(tmp_path / f"a.{suffix}")
    for _ in range(2):
        pictures.save_figure(name, pictures.check(name, False), Figure(figsize=(1, 1)))
    with pytest.raises(ValueError, match="is to be written twice; name another file"):
        pictures.check(name, False, Path(name))
    Path(name).write_text("a drawing")
    with pytest.raises(ValueError, match="exists and is not a picture of ours"):
        pictures.check(name, False)
    assert pictures.check(name, True) == Path(name)
    assert names(tmp_path) == [f"a.{suffix}"]


def test_images_are_pictures_too_and_others_have_a_format_of_none(tmp_path):
    name = str(tmp_path / "a.png")
    pictures.save_image(name, Path(name), np.zeros((4, 4, 3), np.uint8))
    assert pictures.check(name, False) == Path(name)
    with pytest.raises(ValueError, match=r"a\.jpg is of no format for pictures; name a file that ends in \.png, \.svg"):
        pictures.check("a.jpg", False)


def test_a_page_of_somebody_elses_is_not_replaced(tmp_path):
    out = tmp_path / "a.html"
    atomic.write_text(out, page.document("Cassie MJX: evaluations", "", []))
    assert cli.check_output(str(out), page.REPORT, overwrite=False) == out
    out.write_text("<title>Cassie MJX, my notes</title>")
    with pytest.raises(ValueError, match="exists and is not a report of ours"):
        cli.check_output(str(out), page.REPORT, overwrite=False)


def assert_same(one, other):
    """Two policies hold the same; their bytes depend on the version of Python that wrote them."""
    ours, theirs = (archive.read(path, FORMAT) for path in (one, other))
    assert ours.provenance == theirs.provenance
    assert ours.arrays.keys() == theirs.arrays.keys()
    for name, array in ours.arrays.items():
        np.testing.assert_array_equal(array, theirs.arrays[name])


def test_a_policy_goes_where_no_other_file_is_lost(tmp_path, capsys):
    source, out = shipped_policies()["1x"], tmp_path / "a.npz"
    for _ in range(2):
        export.main(ExportConfig(run=str(source), out=str(out)))
        assert_same(out, source)
    with pytest.raises(ValueError, match=r"out=notes\.md is no policy's file; name one that ends in \.npz or \.onnx"):
        ExportConfig(run=str(source), out="notes.md")
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(ValueError, match="exists and is not a policy of ours outside a run"):
        export.main(ExportConfig(run=str(source), out=str(out)))
    export.main(ExportConfig(run=str(source), out=str(out), overwrite=True))
    np.savez(tmp_path / "arrays.npz", a=1)
    with pytest.raises(ValueError, match=r"arrays\.npz exists and is not a policy"):
        cli.check_output(str(tmp_path / "arrays.npz"), POLICY, overwrite=False)
    assert "return_plain" in capsys.readouterr().out


def test_export_gives_an_old_policy_its_digest(tmp_path):
    old, new = tmp_path / "old.npz", tmp_path / "new.npz"
    with np.load(shipped_policies()["1x"]) as content:
        arrays: dict[str, Any] = dict(content) | {"version": 1}
    np.savez(old, **arrays)
    with pytest.warns(UserWarning, match=r"old\.npz is of version 1 .*cassie_mjx.export run=.*old\.npz out="):
        export.main(ExportConfig(run=str(old), out=str(new)))
    assert archive.read(new, FORMAT).has_digest
    assert_same(new, shipped_policies()["1x"])


WAITING = """
import sys, time
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from cassie_mjx import cli
from cassie_mjx.files.atomic import replacing

@dataclass(frozen=True)
class Config:
    out: str

def main(config):
    with replacing(Path(config.out)) as partial:
        partial.write_text("half")
        print("begun", flush=True)
        # A signal that comes just before a sleep does not cut it short, so no sleep here is long.
        for _ in range(600):
            time.sleep(0.1)

cli.run(main, Config)
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_command_that_is_told_to_end_leaves_nothing_half_done(tmp_path, number):
    (tmp_path / "waiting.py").write_text(WAITING)
    command = [sys.executable, str(tmp_path / "waiting.py"), f"out={tmp_path}/a.json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as running:
        assert running.stdout
        assert running.stderr
        assert running.stdout.readline() == "begun\n"
        running.send_signal(number)
        assert running.wait(20) == 128 + number
        assert "Traceback" not in running.stderr.read()
    assert names(tmp_path) == ["waiting.py"]


def test_a_command_has_its_own_sigterm_back_after_a_training():
    with cli.process.as_command():
        before = signal.getsignal(signal.SIGTERM)
        with Interruption(lambda _: None) as interruption:
            signal.raise_signal(signal.SIGTERM)
            assert interruption.signal == signal.SIGTERM
        assert signal.getsignal(signal.SIGTERM) is before


def test_signals_that_are_ignored_stay_so():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with cli.process.as_command():
            assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
            assert callable(signal.getsignal(signal.SIGTERM))
        assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_figure_that_was_altered_is_refused(tmp_path):
    path = tmp_path / "a.json"
    rows = [{"agent": "1x", "quantity": "speed_mps", "value": 0.726, "unit": "m/s", "n": 10}]
    cli.write_result(path, {"rows": rows, "cells": {"walk": (1, 2)}, "provenance": cli.provenance(seed=0)})
    assert read(tmp_path, "a.json").value("speed_mps") == 0.726
    path.write_text(path.read_text().replace("0.726", "0.926"))
    with pytest.raises(ValueError, match=r"a\.json is not a result as expected: its SHA-256 is another"):
        read(tmp_path, "a.json")
