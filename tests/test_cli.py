"""Command lines as dataclasses, and results with their provenance."""

import dataclasses
import importlib
import json
import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest

from cassie_mjx import cli
from cassie_mjx.cli import main as console
from cassie_mjx.cli.explain import field_docs


@dataclass(frozen=True)
class Example:
    out: str = "a.json"
    robots: int = 3
    rates: tuple[int, ...] = (500, 1000)


def test_parse_reads_values_of_their_types():
    for rates in ("rates=[1,2,3]", "rates=1,2,3"):
        assert cli.parse(Example, ["robots=5", rates]) == Example(robots=5, rates=(1, 2, 3))
    assert cli.parse(Example, ["rates=7"]) == Example(rates=(7,))
    assert cli.parse(Example, []) == Example()
    # As the sentence about a value that is no YAML advises.
    assert cli.parse(Example, ["out='@a.json'"]) == Example(out="@a.json")


@pytest.mark.parametrize(
    ("argument", "sentence"),
    [
        ("robot=5", "'robot' is not a key; the keys are out, robots, rates"),
        ("robots", "'robots' is not of the form key=value"),
        ("robots=many", "robots=many: Value 'many' of type 'str' could not be converted to Integer"),
        (
            "rates=[500,1000",
            "'rates=[500,1000' has a value that is no YAML (expected ',' or ']', but got '<stream end>'); close",
        ),
        ("rates=500],1000", "'rates=500],1000' has a value that is no YAML (expected"),
        (
            "out=@a.json",
            "'out=@a.json' has a value that is no YAML (found character '@' that cannot start any token); close",
        ),
        ("out=\a", r"'out=\x07' has a value that is no YAML (unacceptable character #x0007"),
    ],
)
def test_parse_refuses_in_one_sentence(argument, sentence):
    with pytest.raises(ValueError, match=re.escape(sentence)) as raised:
        cli.parse(Example, [argument])
    assert len(str(raised.value).splitlines()) == 1


def test_a_command_ends_with_one_sentence_and_a_status(tmp_path):
    command = [sys.executable, "-m", "experiments.throughput", f"out={tmp_path}/missing/a.json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith(f"error: {tmp_path}/missing/a.json cannot be written")
    assert "Traceback" not in done.stderr


def test_ctrl_c_ends_a_command_with_one_word(monkeypatch, capsys):
    def interrupted(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(sys, "argv", ["example"])
    with pytest.raises(SystemExit) as ended:
        cli.run(interrupted, Example)
    assert ended.value.code == 130
    assert capsys.readouterr().err == "Interrupted.\n"


def test_a_link_is_followed_to_its_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("store").mkdir()
    Path("a.json").symlink_to("store/b")
    for there in (None, "old"):
        if there:
            Path("store/b").write_text(there)
        cli.write_text(cli.check_writable("a.json"), "new")
        assert Path("a.json").is_symlink()
        assert Path("store/b").read_text() == "new"
    Path("folder").symlink_to("store")
    for plain in ("c.json", "store/b", "folder/b", "folder/c"):
        assert cli.check_writable(plain) == Path(plain)


def test_what_is_no_regular_file_is_refused(tmp_path):
    pipe, link, loop, nowhere = (tmp_path / name for name in ("pipe", "link", "loop", "nowhere"))
    os.mkfifo(pipe)
    link.symlink_to(pipe)
    loop.symlink_to(loop)
    nowhere.symlink_to(tmp_path / "missing" / "a.json")
    for path in (pipe, link, loop):
        with pytest.raises(ValueError, match=f"^{path} is not a regular file, and would be replaced by one; name"):
            cli.check_writable(str(path))
    for path in (tmp_path, nowhere):
        with pytest.raises(ValueError, match=f"^{path} cannot be written; name a file in an existing folder"):
            cli.check_writable(str(path))


def test_results_are_written_whole_with_their_provenance(tmp_path):
    path = tmp_path / "a.json"
    path.write_text("precious")
    with pytest.raises(TypeError):
        cli.write_json(path, {"rows": object()})
    assert path.read_text() == "precious"
    cli.write_json(path, {"provenance": cli.provenance(seed=7)})
    provenance = json.loads(path.read_text())["provenance"]
    assert provenance["seed"] == 7
    assert {"command", "commit", "date", "hardware", "python", "versions"} <= provenance.keys()


@pytest.mark.parametrize(
    ("backend", "kinds", "named"),
    [("gpu", 8 * ["NVIDIA H200"], " cores, 8 x NVIDIA H200"), ("cpu", ["cpu"], " cores")],
)
def test_hardware_names_what_jax_computes_on(monkeypatch, backend, kinds, named):
    devices = [SimpleNamespace(device_kind=kind) for kind in kinds]
    jax = SimpleNamespace(default_backend=lambda: backend, devices=lambda: devices)
    monkeypatch.setitem(sys.modules, "jax", jax)
    assert cli.provenance()["hardware"].endswith(named)


def test_provenance_leaves_jax_alone_where_nothing_uses_it():
    program = "import sys; from cassie_mjx import cli; cli.provenance(); assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-c", program], check=True)


ROOT = Path(__file__).parents[1]
COMMANDS = ("train", "evaluate", "render", "view", "export")
EXPERIMENTS = sorted(path.stem for path in (ROOT / "experiments").glob("*.py") if "cli.run(main, " in path.read_text())


@pytest.mark.parametrize(
    "name", [*(f"cassie_mjx.{each}" for each in COMMANDS), *(f"experiments.{e}" for e in EXPERIMENTS)]
)
def test_help_explains_every_key(monkeypatch, capsys, name):
    module = importlib.import_module(name)
    config_class = next(
        value
        for key, value in vars(module).items()
        if key.endswith("Config") and f"cli.run(main, {key}" in Path(str(module.__file__)).read_text()
    )
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    cli.run(module.main, config_class, {"walk": cli.Group("a", {"a": 1})} if name.endswith("train") else None)
    shown = capsys.readouterr().out
    for key, text in field_docs(config_class).items():
        assert f"  {key}=" in shown or f"  {key}." in shown
        assert text.split()[0] in shown
    assert {field.name for field in dataclasses.fields(config_class)} == field_docs(config_class).keys()


def test_help_shows_defaults_choices_and_nested_keys(monkeypatch, capsys):
    from cassie_mjx.training.config import PRESETS, TrainConfig

    monkeypatch.setattr(sys, "argv", ["train", "-h"])
    cli.run(print, TrainConfig, {key: cli.Group(*presets) for key, presets in PRESETS.items()})
    shown = " ".join(capsys.readouterr().out.split())
    for part in (
        "walk=undisturbed Presets: undisturbed, robust.",
        "ppo.hidden_sizes=256,256",
        "ppo.target_kl=0.05",
        "walk.scenario.push_n=0.0 Force of a push at the pelvis, N",
        "Choices: auto, native, mjx.",
        "init=null",
    ):
        assert part in shown


def test_the_console_script_lists_and_runs_the_commands(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["cassie-mjx"])
    console.main()
    shown = capsys.readouterr().out
    assert all(f"  {name}" in shown for name in COMMANDS)
    monkeypatch.setattr(sys, "argv", ["cassie-mjx", "export", "--help"])
    console.main()
    assert "  run=..." in capsys.readouterr().out
    monkeypatch.setattr(sys, "argv", ["cassie-mjx", "fly"])
    with pytest.raises(SystemExit, match="2"):
        console.main()
    assert (
        capsys.readouterr().err == f"error: 'fly' is not a command; the commands are {', '.join(console.COMMANDS)}.\n"
    )
