"""A short run of `tests.fuzz`; the long one is by hand."""

import random

import pytest

from tests.fuzz import files, kills, values
from tests.fuzz.outcome import DIFFERENT, FAULTS, HANG, REFUSED, TRACEBACK, summary, tried


def test_damaged_files_are_noticed(tmp_path):
    outcomes = list(files.attempts(tmp_path, 25, seed=1))
    assert len(outcomes) == 100
    assert not [each for each in outcomes if each.kind in FAULTS], summary(outcomes)
    assert sum(each.kind == REFUSED for each in outcomes) > 45


def test_wrong_values_are_refused_in_a_sentence():
    outcomes = list(values.attempts(6, seed=1))
    assert not [each for each in outcomes if each.kind in FAULTS], summary(outcomes)
    assert sum(each.kind == REFUSED for each in outcomes) > 50


@pytest.mark.slow
def test_a_stopped_training_comes_to_the_same_end(tmp_path):
    outcomes = list(kills.attempts(tmp_path, 1, seed=1))
    assert not [each for each in outcomes if each.kind in FAULTS], summary(outcomes)


def test_faults_are_told_from_refusals(monkeypatch):
    def refuse():
        raise ValueError("This is wrong.")

    def ramble():
        raise ValueError("two\nlines")

    def hang():
        while True:
            pass

    monkeypatch.setattr("tests.fuzz.outcome.HANG_S", 1)
    for call, kind in (
        (refuse, REFUSED),
        (ramble, TRACEBACK),
        (hang, HANG),
        (lambda: {}[0], TRACEBACK),
        (int, DIFFERENT),
    ):
        assert tried("an attempt", call, lambda value: value == 1).kind == kind


def test_every_damage_changes_the_content():
    rng, content = random.Random(0), bytes(range(256)) * 8
    assert all(files.damaged(content, rng)[1] != content for _ in range(300))
