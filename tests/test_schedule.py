"""When a run saves a checkpoint, and when it measures the return."""

import json
from dataclasses import replace

import pytest
from tiny import config

from cassie_mjx.ppo.config import PPOConfig
from cassie_mjx.training import runner, schedule
from cassie_mjx.training.config import TrainConfig


def iterations(config: TrainConfig, walked: float) -> tuple[list[int], list[int]]:
    """Iterations with a checkpoint, and those of them with a measurement, of policies that all walk so long."""
    saved = [i for i in range(1, config.ppo.iterations + 1) if schedule.saves(config, i)]
    return saved, [i for i in saved if schedule.measures(config, i, walked)]


def test_falling_policies_are_measured_often_and_walking_ones_seldom():
    default = TrainConfig()
    thirty = list(range(40, 1201, 40))
    assert iterations(default, walked=299.9) == (thirty, thirty)
    assert iterations(default, walked=300) == (thirty, [400, 800, 1200])


@pytest.mark.parametrize(("count", "last"), [(1, 1), (7, 7), (29, 29), (605, 605)])
def test_the_last_iteration_is_measured(count, last):
    config = TrainConfig(ppo=PPOConfig(iterations=count))
    assert iterations(config, walked=300)[1][-1] == last


def test_a_wish_is_followed():
    saved, measured = iterations(TrainConfig(evaluate_every=7, ppo=PPOConfig(iterations=30)), walked=300)
    assert saved == measured == [7, 14, 21, 28, 30]


def test_lines_without_a_measurement_have_all_else(tmp_path, monkeypatch):
    walking = {"return_plain": 280.0, "return_weighted": 270.0, "steps": 300.0}
    monkeypatch.setattr(runner, "walk_returns", lambda *_: walking)
    started = config(tmp_path / "run")
    runner.train_policy(replace(started, evaluate_every=None, ppo=replace(started.ppo, iterations=4)))
    lines = [json.loads(line) for line in (tmp_path / "run/metrics.jsonl").read_text().splitlines()]
    assert [line["train/iteration"] for line in lines] == [1, 2, 3, 4]
    assert ["eval/steps" in line for line in lines] == [True, False, False, True]
    for line in lines:
        assert {name for name in lines[0] if not name.startswith("eval/")} <= line.keys()
