"""What `--help` says of every command, and the console script."""

import runpy
import subprocess
import sys
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import get_type_hints

import pytest

from cassie_mjx import cli
from cassie_mjx.cli import main as console
from cassie_mjx.training.config import PRESETS, TrainConfig

ROOT = Path(__file__).parents[1]
FILES = [path for folder in ("cassie_mjx", "experiments") for path in sorted((ROOT / folder).glob("*.py"))]
COMMANDS = [path for path in FILES if "__main__" in path.read_text()]


def names(config_class, prefix=""):
    """Dotted names of all fields."""
    for field in fields(config_class):
        kind = get_type_hints(config_class)[field.name]
        if is_dataclass(kind):
            yield from names(kind, f"{prefix}{field.name}.")
        else:
            yield prefix + field.name


def helped(monkeypatch, capsys, path, columns="120"):
    """What a file prints for --help: entries name=default to text, the whole, and the command's configuration."""
    configs, run = [], cli.run
    monkeypatch.setenv("COLUMNS", columns)
    monkeypatch.setattr(cli, "run", lambda main, config, *more: configs.append(config) or run(main, config, *more))
    monkeypatch.setattr(sys, "argv", [str(path), "--help"])
    runpy.run_path(str(path), run_name="__main__")
    shown = capsys.readouterr()
    assert not shown.err
    entries = [part.strip().partition("\n") for part in shown.out.split("\n\n") if part.startswith("  ")]
    return {title: " ".join(text.split()) for title, _, text in entries}, shown.out, configs[0]


def test_all_commands_are_here():
    assert {path.stem for path in COMMANDS if path.parent.name == "cassie_mjx"} == set(console.COMMANDS)
    assert len(COMMANDS) > 20


@pytest.mark.parametrize("path", COMMANDS, ids=lambda path: f"{path.parent.name}.{path.stem}")
def test_help_has_every_key_with_its_sentence(monkeypatch, capsys, path):
    entries, shown, config_class = helped(monkeypatch, capsys, path)
    keys = {title.partition("=")[0]: text for title, text in entries.items()}
    assert set(names(config_class)) <= keys.keys()
    assert all(keys.values()), "a sentence under every field"
    assert f"python -m {path.parent.name}.{path.stem}" in shown.split("\n\n")[0]
    assert max(map(len, shown.splitlines())) <= 120


def test_help_has_defaults_choices_and_presets(monkeypatch, capsys):
    entries, shown, _ = helped(monkeypatch, capsys, ROOT / "cassie_mjx" / "train.py", columns="70")
    assert max(map(len, shown.splitlines())) <= 70
    assert entries["init=null"].startswith("Policy to start from")
    assert entries["physics=auto"].endswith("Choices: auto, native, mjx.")
    assert entries["walk.reward=weighted"].endswith("Choices: plain, weighted.")
    assert entries["ppo.hidden_sizes=256,256"].startswith("Widths of the ReLU layers")
    assert entries["walk.scenario.push_n=0.0"].startswith("Force of a push at the pelvis, N")
    assert entries["resume=false"]
    massive = {"ppo.num_robots=4096", "ppo.num_steps=16", "ppo.iterations=300", "ppo.minibatch_size=8192"}
    assert massive <= set(entries["ppo=massive"].split())
    robust = entries["walk=robust"].split()
    assert {"walk.min_reward=null", "walk.kd_scale=0.3", "walk.scenario.terrain_m=0.25"} <= set(robust)
    changed = cli.parse(TrainConfig, robust, {name: cli.Group(*group) for name, group in PRESETS.items()})
    assert changed.walk == PRESETS["walk"][1]["robust"]


COMMAND = '''
"""A command."""

from dataclasses import dataclass

from cassie_mjx import cli
from cassie_mjx.configuration.values import Checked


@dataclass(frozen=True)
class Config(Checked):
    """Its keys."""

    out: str
    """File to write."""


cli.run(print, Config)
'''


def test_help_names_a_key_that_must_be_given(monkeypatch, capsys, tmp_path):
    command = tmp_path / "command.py"
    command.write_text(COMMAND)
    entries, _, _ = helped(monkeypatch, capsys, command)
    assert entries["out=..."] == "File to write. It must be given."


def test_help_into_a_pipe_that_closes_is_no_error():
    # `true` is over long before the command has imported what it needs.
    command = ["bash", "-o", "pipefail", "-c", f"{sys.executable} -m cassie_mjx.train --help | true"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert (done.returncode, done.stderr) == (0, "")


def ended(monkeypatch, capsys, *arguments):
    monkeypatch.setattr(sys, "argv", ["cassie-mjx", *arguments])
    with pytest.raises(SystemExit) as status:
        console.main()
    return status.value.code, capsys.readouterr().err


@pytest.mark.parametrize("arguments", [[], ["--help"], ["-h"]])
def test_the_console_script_lists_the_commands(monkeypatch, capsys, arguments):
    monkeypatch.setattr(sys, "argv", ["cassie-mjx", *arguments])
    console.main()
    shown = {line.split()[0]: line.split(maxsplit=1)[1] for line in capsys.readouterr().out.splitlines()[2:]}
    assert shown.keys() == set(console.COMMANDS)
    assert shown["train"] == "Train a policy."
    assert all(sentence.endswith(".") for sentence in shown.values())


def test_the_console_script_runs_a_command(monkeypatch, capsys, tmp_path):
    status, said = ended(monkeypatch, capsys, "export", f"run={tmp_path}", f"out={tmp_path}/a.npz")
    assert (status, said) == (2, f"error: There is no policy file {tmp_path}/best.npz.\n")


@pytest.mark.parametrize(("word", "hint"), [("fly", ""), ("trian", " Did you mean train?")])
def test_the_console_script_names_the_commands(monkeypatch, capsys, word, hint):
    known = "train, evaluate, render, view, demo, export, report"
    expected = f"error: {word!r} is not a command; the commands are {known}.{hint}\n"
    assert ended(monkeypatch, capsys, word) == (2, expected)


def test_listing_the_commands_imports_none():
    listing = "from cassie_mjx.cli.main import main; main()"
    program = f"import sys; {listing}; assert not {{'jax', 'mujoco', 'hydra'}} & set(sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=ROOT)
    assert "  evaluate" in done.stdout
