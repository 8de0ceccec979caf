"""What values can be: ranges and choices, the same for a command line and for a program."""

import io
import runpy
from dataclasses import dataclass
from typing import Annotated, get_args

import numpy as np
import pytest
from rich.console import Console
from test_help import COMMANDS

from cassie_mjx import cli
from cassie_mjx.cli.keys import keys_of
from cassie_mjx.configuration.values import Checked, Range, label
from cassie_mjx.training.config import PRESETS, TrainConfig
from cassie_mjx.training.loggers import Terminal
from experiments.agreement import AgreementConfig
from experiments.contacts import ContactsConfig
from experiments.portrait import PortraitConfig
from experiments.throughput import ThroughputConfig


@dataclass(frozen=True)
class Example(Checked):
    share: Annotated[float, Range(0, 1)] = 0.5
    count: Annotated[int, Range(1, 2000)] | None = None
    sizes: tuple[Annotated[int, Range(1, 9)], ...] = (1,)
    force: tuple[Annotated[float, Range(-5, 5)], Annotated[float, Range(-5, 5)]] = (0.0, 0.0)
    out: str = "a.b/c.json"


def numbers(kind):
    """Whether a type has a number in it."""
    return kind in (int, float) or any(map(numbers, get_args(kind)))


@pytest.mark.parametrize("path", COMMANDS, ids=lambda path: f"{path.parent.name}.{path.stem}")
def test_every_number_of_every_command_has_a_finite_range(monkeypatch, path):
    asked = []

    def run(main, config_class, groups=None, *more):
        assert issubclass(config_class, Checked)
        asked.extend(keys_of(config_class, groups or {}).items())

    monkeypatch.setattr(cli, "run", run)
    runpy.run_path(str(path), run_name="__main__")
    assert asked
    for name, key in asked:
        assert bool(key.allowed.range) == numbers(key.kind), f"{name} needs a Range"
        if key.allowed.range:
            assert np.isfinite(key.allowed.range).all(), name
            assert f"{key.allowed.range}".startswith("from "), name


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"share": 1.5}, "share=1.5 must be from 0 to 1."),
        ({"share": float("nan")}, "share=nan must be from 0 to 1."),
        ({"share": -float("inf")}, "share=-inf must be from 0 to 1."),
        ({"share": "1"}, "share=1 must be from 0 to 1."),
        ({"share": None}, "share=null must be from 0 to 1."),
        ({"count": 0}, "count=0 must be a whole number from 1 to 2,000, or null."),
        ({"count": 1.5}, "count=1.5 must be a whole number from 1 to 2,000, or null."),
        ({"sizes": (1, 10)}, "sizes=1,10: each must be a whole number from 1 to 9."),
        ({"force": (0.0, float("nan"))}, "force=0.0,nan: each must be from -5 to 5."),
        ({"force": (0.0,)}, "force=0.0 must be 2 values, with commas between."),
    ],
)
def test_a_value_out_of_range_is_refused_in_a_sentence(changes, sentence):
    with pytest.raises(ValueError, match=f"^{sentence}$"):
        Example(**changes)


def test_values_in_range_are_taken():
    values = {"share": np.float32(0.25), "count": np.int64(5), "sizes": [1, 9], "force": (5, -5)}
    assert vars(Example(**values)) == values | {"out": "a.b/c.json"}


@pytest.mark.parametrize(
    ("config_class", "argument"),
    [
        (ContactsConfig, "push_n=nan"),
        (ThroughputConfig, "native_robots=0"),
        (ThroughputConfig, "mjx_robots=4,0"),
        (PortraitConfig, "sample=99"),
        (AgreementConfig, "seed=-1"),
        (TrainConfig, "ppo.num_robots=1000000000"),
        (TrainConfig, "ppo.action_std=inf"),
        (TrainConfig, "physics_hz=1000000000"),
        (TrainConfig, "walk.scenario.delay_s=1000"),
    ],
)
def test_what_can_only_crash_or_hang_is_refused_by_its_name(config_class, argument):
    name = argument.partition("=")[0]
    with pytest.raises(ValueError, match=rf"^{name}=[^ ]+ (each )?must be .*from [-\d.,]+ to [\d.,]+(, or null)?\.$"):
        cli.parse(config_class, [argument], {key: cli.Group(*presets) for key, presets in PRESETS.items()})


def test_a_comparison_needs_a_speed():
    with pytest.raises(ValueError, match="^speeds is empty; name at least one, such as speeds=1.$"):
        cli.parse(AgreementConfig, ["speeds="])


def test_each_combination_has_result_files_of_its_own():
    one, other = (Example().apart({"share": share, "count": "3"}) for share in ("0.25", "0.5"))
    assert (one.out, other.out) == ("a.b/c-count=3-share=0.25.json", "a.b/c-count=3-share=0.5.json")
    assert Example(out="").apart({"share": "0.25"}).out == ""
    assert Example().apart({"out": "a.b/c.json"}).out == "a.b/c.json"
    assert Example().apart({"out": "a.b/c.json", "share": "0.25"}).out == "a.b/c-share=0.25.json"


def test_each_run_of_a_sweep_has_a_directory_of_its_own():
    def folder(swept, **changes):
        return str(TrainConfig(**changes).apart(swept).folder)

    assert folder({"seed": "3", "speed": "1.5x"}, seed=3, speed="1.5x") == "runs/1.5x-seed3"
    assert folder({"seed": "3", "ppo.gamma": "0.98"}, seed=3) == "runs/1x-seed3-ppo.gamma=0.98"
    assert folder({"seed": "3"}, seed=3, run_dir="runs/1.5x") == "runs/1.5x-seed=3"
    assert folder({"run_dir": "a"}, run_dir="a") == "a"


def test_labels_are_names_and_differ():
    texts = ["a/b", "a_b", "a%2Fb", "ä", "a b", "[1,2]", 300 * "x", 300 * "x" + "y"]
    labels = [label({"init": text}) for text in texts]
    assert len(set(labels)) == len(texts)
    assert all("/" not in each and len(each) < 200 for each in labels)
    assert label({}) == ""


def test_brackets_in_a_name_are_printed():
    console = Console(file=io.StringIO())
    Terminal(console, 1, 0).say("The policy: runs/a[old]/best.npz")
    assert console.file.getvalue() == "The policy: runs/a[old]/best.npz\n"


@pytest.mark.parametrize("changes", [{"evaluate_every": (3, 4)}, {"log": "jsonl"}, {"seed": 10**400}])
def test_one_value_is_no_tuple_and_a_huge_number_is_out_of_range(changes):
    with pytest.raises(ValueError, match=f"^{next(iter(changes))}=.* must be "):
        TrainConfig(**changes)
