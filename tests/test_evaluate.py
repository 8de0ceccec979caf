"""The evaluation file and its command line."""

import json
import subprocess
import sys

import pytest

from cassie_mjx import cli, evaluate
from cassie_mjx.evaluate import EvaluateConfig
from cassie_mjx.evaluation import suites
from cassie_mjx.evaluation.setup import SuiteResult
from cassie_mjx.evaluation.trial import Metric


def test_the_file_has_rows_and_provenance(tmp_path, monkeypatch):
    speed, height = Metric("speed_mps", 0.7, "m/s", 10), Metric("terrain_h_m", 0.1, "m", 8)
    found = {"walk": [speed], "delay": [], "terrain": [height], "push": []}
    asked = []

    def suite(name):
        return lambda agent, setting: asked.append((name, setting.engine, setting.long)) or SuiteResult(found[name])

    monkeypatch.setattr(evaluate, "SUITES", {name: suite(name) for name in found})
    evaluate.main(EvaluateConfig(policy="controller:stiff", long=True, physics="mjx", out=str(tmp_path / "a.json")))
    assert asked == [(name, "mjx", True) for name in ("walk", "delay", "terrain", "push")]
    content = json.loads((tmp_path / "a.json").read_text())
    assert content.keys() == {"rows", "provenance", "sha256"}
    assert content["rows"] == [
        {"agent": "controller:stiff", "quantity": "speed_mps", "value": 0.7, "unit": "m/s", "n": 10},
        {"agent": "controller:stiff", "quantity": "terrain_h_m", "value": 0.1, "unit": "m", "n": 8},
    ]
    assert content["provenance"]["policy"] == "controller:stiff"
    assert list(content["provenance"]["seconds"]) == ["walk", "delay", "terrain", "push"]


def test_cells_and_the_policys_own_provenance_go_to_the_file(tmp_path, monkeypatch):
    monkeypatch.setitem(suites.SUITES, "map", lambda agent, setting: SuiteResult([], {"survived": [["10"]]}))
    evaluate.main(EvaluateConfig(policy="1x", suite="map", out=str(tmp_path / "a.json")))
    content = json.loads((tmp_path / "a.json").read_text())
    assert content["map"] == {"survived": [["10"]]}
    assert content["provenance"]["agent"].keys() >= {"seed", "commit", "samples", "return_plain"}


@pytest.mark.parametrize(
    ("argument", "sentence"),
    [
        (
            "suite=jump",
            "suite=jump is not known; choose one of walk, delay, terrain, ground, push, map, forces, command, dynamics",
        ),
        ("physics=warp", "physics=warp is not known; choose one of native, mjx"),
        (
            "velocity=2",
            "'velocity' is not a key; the keys are policy, speed, schedule, command, suite, long, ",
        ),
    ],
)
def test_bad_input_gets_one_sentence(argument, sentence):
    with pytest.raises(ValueError, match=sentence):
        cli.parse(EvaluateConfig, [argument])


def test_a_file_that_cannot_be_written_is_refused_before_the_work(tmp_path):
    with pytest.raises(ValueError, match="cannot be written"):
        evaluate.main(EvaluateConfig(out=str(tmp_path / "missing" / "a.json")))


def test_an_unknown_policy_ends_the_command_with_one_sentence(tmp_path):
    (tmp_path / "a.json").write_text("precious")
    command = [sys.executable, "-m", "cassie_mjx.evaluate", "policy=9x", f"out={tmp_path}/a.json", "overwrite=true"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    known = "0x, 1x, 1x-robust, 1x-sensors, 2x, 3x, 4x, any, joystick, controller:stiff,"
    assert done.stderr.splitlines()[-1].startswith(f"error: policy=9x is none of {known}")
    assert "Traceback" not in done.stderr
    assert (tmp_path / "a.json").read_text() == "precious"
