"""Sweeps from the command line: every combination is done, each with results of its own."""

import sys
from dataclasses import dataclass
from typing import Annotated

import pytest

from cassie_mjx import cli
from cassie_mjx.cli.keys import keys_of
from cassie_mjx.cli.reading import values_of
from cassie_mjx.cli.sweep import is_hydras, sweep
from cassie_mjx.configuration.values import Checked, Range


@dataclass(frozen=True)
class Walk(Checked):
    speed: Annotated[float, Range(0, 4)] = 1.0
    gains: tuple[Annotated[float, Range(0, 9)], ...] = (1.0,)
    name: str = "a"
    out: str = "walk.json"


def ran(monkeypatch, tmp_path, *arguments, main=None):
    seen = []

    def walk(config):
        seen.append(config)
        if main:
            main(config)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["walks", "-m", *arguments])
    try:
        cli.run(walk, Walk)
    except SystemExit as ended:
        return seen, ended.code
    return seen, 0


def test_combinations_have_files_of_their_own(monkeypatch, tmp_path):
    seen, _ = ran(monkeypatch, tmp_path, "speed=0.5,1.5", "name=b")
    assert [each.out for each in seen] == ["walk-speed=0.5.json", "walk-speed=1.5.json"]
    seen, _ = ran(monkeypatch, tmp_path, "speed=0.5", "name=b")
    assert [each.out for each in seen] == ["walk.json"]
    seen, _ = ran(monkeypatch, tmp_path, "name=x/y,z", "gains=[1,2],3", "out=b.json")
    assert [each.out for each in seen] == [
        *(f"b-gains={gains}-name={name}.json" for name in ("x%2Fy", "z") for gains in ("%5B1%2C2%5D", "3"))
    ]


def test_a_combination_that_is_refused_or_fails_does_not_stop_the_others(monkeypatch, tmp_path, capsys):
    def main(config):
        if config.speed == 1:
            raise ValueError("It fell.")
        if config.speed == 2:
            raise ZeroDivisionError

    seen, status = ran(monkeypatch, tmp_path, "speed=1,9,2,3,x", main=main)
    assert ([each.speed for each in seen], status) == ([1, 2, 3], 2)
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert said == [
        "error: It fell.",
        "error: speed=9.0 must be from 0 to 4.",
        "error: speed=x: 'x' is not a number.",
        "error: 4 of the combinations failed: speed=1; speed=9; speed=2; speed=x.",
    ]


def test_ctrl_c_stops_all_combinations(monkeypatch, tmp_path, capsys):
    def main(_):
        raise KeyboardInterrupt

    seen, status = ran(monkeypatch, tmp_path, "speed=1,2", main=main)
    assert (len(seen), status) == (1, 130)
    assert capsys.readouterr().err == "Interrupted.\n"


def test_hydras_own_ways_to_name_many_numbers_work(monkeypatch, tmp_path):
    seen, _ = ran(monkeypatch, tmp_path, "speed=range(1,3)", "name=choice(a")
    assert [(each.speed, each.name) for each in seen] == [(1, "choice(a"), (2, "choice(a")]


def test_a_failure_in_another_process_is_brought_back(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["walks", "-m", "speed=1,2"])
    pids = iter([1, 2, 3])
    monkeypatch.setattr("cassie_mjx.cli.sweep.os.getpid", lambda: next(pids))

    def job(arguments, swept):
        raise ValueError(arguments)

    with pytest.raises(ValueError, match="^speed=1 failed, and maybe others; the launcher's logs say why.$"):
        sweep(["-m", "speed=1,2"], keys_of(Walk, {}), job)


def test_what_is_hydras():
    hydras = ["-m", "hydra.job.name=a", "hydra/launcher=b", "--cfg=hydra"]
    ours = ["speed=1", "--speed=1", "hydras=1", "name=-x"]
    assert [is_hydras(each) for each in hydras + ours] == 4 * [True] + 4 * [False]


def test_values_of_a_sweep_are_parted_at_their_commas():
    assert values_of("", "a[old],'b,c',it's", str) == ["a[old]", "b,c", "it's"]
    assert values_of("", "[1,2],3,[4]", tuple[int, ...]) == ["[1,2]", "3", "[4]"]
    assert values_of("", "null,[1,2]", tuple[int, int] | None) == ["null", "[1,2]"]
