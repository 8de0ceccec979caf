"""Command lines as dataclasses, and results with their provenance."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import pytest

from cassie_mjx import cli
from cassie_mjx.configuration.values import Checked


@dataclass(frozen=True)
class Example(Checked):
    out: str = "a.json"
    robots: int = 3
    rates: tuple[int, ...] = (500, 1000)


@dataclass(frozen=True)
class Legs(Checked):
    number: int = 2
    lengths: tuple[float, ...] = (1.0,)
    colour: str = "red"

    CHOICES: ClassVar[Mapping[str, Sequence[str]]] = {"colour": ("red", "green")}


@dataclass(frozen=True)
class Animal(Checked):
    name: str
    legs: Legs = field(default_factory=Legs)
    tail: tuple[int, int] | None = None


LEGS = {"legs": cli.Group("two", {"two": Legs(), "spider": Legs(8, (0.5, 0.25), "green")})}


def test_parse_reads_values_of_their_types():
    for rates in ("rates=[1,2,3]", "rates=1,2,3"):
        assert cli.parse(Example, ["robots=5", rates]) == Example(robots=5, rates=(1, 2, 3))
    assert cli.parse(Example, ["rates=7"]) == Example(rates=(7,))
    assert cli.parse(Example, []) == Example()
    assert cli.parse(Example, ["robots=1e3"]).robots == 1000
    assert cli.parse(Animal, ["name=a", "legs.lengths=1,0.5e1"]).legs.lengths == (1.0, 5.0)


@pytest.mark.parametrize(
    ("argument", "sentence"),
    [
        ("robot=5", "'robot' is not a key; the keys are out, robots, rates"),
        ("robots", "'robots' is not of the form key=value"),
        ("robots=many", "robots=many: 'many' is not a whole number."),
        ("robots=", "robots=: '' is not a whole number."),
        ("robots=2.5", "robots=2.5: '2.5' is not a whole number."),
        ("robots=null", "robots=null: 'null' is not a whole number."),
        (
            "rates=[500,1000",
            "rates=[500,1000: '[500' is not a whole number.",
        ),
        ("--robots=5", "'--robots' is not a key; the keys are out, robots, rates. Did you mean robots?"),
        ("--robots", "'--robots' is not of the form key=value; the keys are out, robots, rates. Write robots=VALUE."),
        ("robots:5", "'robots:5' is not of the form key=value; the keys are out, robots, rates. Write robots=5."),
        ("5", "'5' is not of the form key=value; the keys are out, robots, rates."),
    ],
)
def test_parse_refuses_in_one_sentence(argument, sentence):
    with pytest.raises(ValueError, match=re.escape(sentence)) as raised:
        cli.parse(Example, [argument])
    assert len(str(raised.value).splitlines()) == 1


def test_nested_keys_count_on_top_of_presets_wherever_they_stand():
    spider = Legs(8, (0.5, 0.25), "green")
    assert cli.parse(Animal, ["name=a"], LEGS) == Animal("a")
    assert cli.parse(Animal, ["legs.number=6", "name=a", "legs=spider"], LEGS) == Animal("a", replace(spider, number=6))
    assert cli.parse(Animal, ["name=a", "legs=spider", "legs.lengths=1,2"], LEGS).legs.lengths == (1.0, 2.0)
    assert cli.parse(Animal, ["name=a", "legs.number=3", "legs.number=4"]).legs.number == 4
    tails = {"1,2": (1, 2), "[1,2]": (1, 2), "null": None}
    assert {text: cli.parse(Animal, ["name=a", f"tail={text}"]).tail for text in tails} == tails


NAMES = [
    *("a b/x.npz", "Läufer=1.npz", "blend:1x,2x", "runs/1-seed0", "1x", "'@a'", "a\\b", "", "/home/jürgen/x", "[1,2]"),
    *("a[old]/x.npz", "a]b", "${nothing}", "100%", "~", "-x", "it's", '"a"', "a: b", "# a", "null", "010", "1e3"),
]


@pytest.mark.parametrize("text", NAMES)
def test_text_is_taken_as_it_stands(text):
    assert cli.parse(Example, [f"out={text}"]).out == text


@pytest.mark.parametrize("text", NAMES)
def test_text_is_taken_as_it_stands_in_a_sweep(monkeypatch, tmp_path, text):
    if "," in text:
        text = f"'{text}'"
    monkeypatch.chdir(tmp_path)
    (seen,) = run(monkeypatch, "-m", f"name={text}")
    assert seen.name == (text[1:-1] if "," in text or text == "'@a'" else text)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ([], "name must be given, as in name=..."),
        (["name=a", "legs=snake"], "legs=snake is not known; choose one of two, spider."),
        (["name=a", "legs=spidr"], "legs=spidr is not known; choose one of two, spider. Did you mean spider?"),
        (["legs.colour=gren"], "legs.colour=gren is not known; choose one of red, green. Did you mean green?"),
        (["legs.toes=5"], "'legs.toes' is not a key; the keys are number, lengths, colour."),
        (["nam=a"], "'nam' is not a key; the keys are name, legs, tail. Did you mean name?"),
        (["number=3"], "'number' is not a key; the keys are name, legs, tail. Did you mean legs.number?"),
        (
            ["legs.number=2,3"],
            "legs.number=2,3: '2,3' is not a whole number; -m legs.number=2,3 runs one after another.",
        ),
        (["legs.number=null"], "legs.number=null: "),
        (["--name=a"], "'--name' is not a key; the keys are name, legs, tail. Did you mean name?"),
    ],
)
def test_mistakes_name_what_there_is(arguments, sentence):
    with pytest.raises(ValueError, match=re.escape(sentence)) as raised:
        cli.parse(Animal, arguments, LEGS)
    assert len(str(raised.value).splitlines()) == 1


def test_a_choice_is_checked_where_a_program_makes_it_too():
    with pytest.raises(ValueError, match="^colour=blue is not known; choose one of red, green.$"):
        Legs(colour="blue")
    with pytest.raises(ValueError, match="^colour=null is not known; choose one of red, green.$"):
        Legs(colour=None)  # pyright: ignore[reportArgumentType]


def run(monkeypatch, *arguments, renamed=None):
    seen = []
    monkeypatch.setattr(sys, "argv", ["animals", *arguments])
    cli.run(seen.append, Animal, LEGS, renamed)
    return seen


def test_old_names_of_keys_work_and_say_the_new_ones(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    renamed = {"title": "name", "feet.": "legs."}
    assert run(monkeypatch, "title=a", "feet.number=4", renamed=renamed) == [Animal("a", Legs(4))]
    assert capsys.readouterr().err == "title is now called name.\nfeet.number is now called legs.number.\n"
    seen = run(monkeypatch, "-m", "title=a", "feet.number=4,5", renamed=renamed)
    assert [each.legs.number for each in seen] == [4, 5]
    assert len(capsys.readouterr().err.splitlines()) == 2, "once, not for each job"
    with pytest.raises(SystemExit, match="2"):
        run(monkeypatch, "feet.toes=4", renamed=renamed)
    assert "error: 'legs.toes' is not a key; the keys are number," in capsys.readouterr().err


def test_a_sweep_reads_values_as_a_single_command_does(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    arguments = ["name='a b','Läufer=1.npz','c,d',null1", "legs=spider", "legs.lengths=[1,2]", "tail=null"]
    seen = run(monkeypatch, "-m", *arguments)
    assert [each.name for each in seen] == ["a b", "Läufer=1.npz", "c,d", "null1"]
    assert {(each.legs.number, each.legs.lengths, each.tail) for each in seen} == {(8, (1.0, 2.0), None)}


def test_a_job_of_a_sweep_sees_the_command_that_was_typed(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    line, seen = ["cassie-mjx train", "-m", "name=a,b"], []
    monkeypatch.setattr(sys, "argv", line)
    cli.run(lambda _: seen.append((list(sys.argv), cli.provenance()["command"])), Animal, LEGS)
    assert seen == 2 * [(line, "cassie-mjx train -m name=a,b")]
    assert sys.argv is line


def test_a_sweep_with_an_unknown_key_starts_no_job(monkeypatch, capsys):
    with pytest.raises(SystemExit, match="2"):
        run(monkeypatch, "-m", "name=a,b", "leg=spider")
    (line,) = capsys.readouterr().err.splitlines()
    assert line == "error: 'leg' is not a key; the keys are name, legs, tail. Did you mean legs?"


def test_options_of_a_launcher_are_listed(monkeypatch, capsys):
    run(monkeypatch, "name=a", "hydra/launcher=basic", "--cfg", "hydra", "-p", "hydra.launcher")
    assert "basic_launcher.BasicLauncher" in capsys.readouterr().out


def test_provenance_has_a_command_that_a_shell_reads(monkeypatch):
    for first, begins in (("/a/cassie_mjx/train.py", "python -m cassie_mjx.train"), ("cassie-mjx train", None)):
        monkeypatch.setattr(sys, "argv", [first, "speed=1x", "init=a b.npz"])
        assert cli.provenance()["command"] == f"{begins or first} speed=1x 'init=a b.npz'"


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


def test_provenance_names_the_commit():
    git = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short=12", "HEAD"]
    head = subprocess.run(git, capture_output=True, text=True, check=False)
    if head.returncode:
        pytest.skip("no git checkout")
    assert cli.provenance()["commit"].startswith(head.stdout.strip())
