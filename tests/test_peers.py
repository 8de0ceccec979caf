"""Our learner beside others: budgets, goals and the table by hand; each learner for a few thousand steps."""

import json
import re
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
import tiny
from rich.console import Console

from cassie_mjx.envs.make import make_env
from experiments import peers
from experiments.learners import meter
from experiments.peers import LEARNERS, PeersConfig, command, is_over, learn, main, row, table, within


def config(folder, **changes):
    return PeersConfig(**{"runs": str(folder / "runs"), "out": str(folder / "out.json"), "seeds": (0,)} | changes)


def points(*returns):
    """A measurement every 1000 samples and 10 s."""
    return [{"samples": 1000 * k, "train_s": 10.0 * k, "return_plain": r} for k, r in enumerate(returns, 1)]


def metrics(*returns):
    """The lines of a run's metrics.jsonl, of which the last is still being written."""
    names = {"samples": "train/samples", "train_s": "time/train_s", "return_plain": "eval/return_plain"}
    lines = [json.dumps({names[key]: value for key, value in point.items()}) for point in points(*returns)]
    return "\n".join([*lines, '{"train/sam'])


def fake_runs(monkeypatch, curves):
    """Instead of a run, what it would write; returns the commands."""
    made = []

    def follow(arguments, is_over):
        folder = Path(dict(each.split("=", 1) for each in arguments[3:])["run_dir"])
        folder.mkdir(parents=True)
        (folder / "metrics.jsonl").write_text(metrics(*curves[folder.name]))
        made.append(arguments)

    monkeypatch.setattr(peers, "_follow", follow)
    return made


def test_runs_are_made_once_and_the_table_says_what_was_not_reached(monkeypatch, tmp_path):
    made = fake_runs(monkeypatch, {"ours-seed0": (20, 160, 140, 250.5), "brax-seed0": (9.0, 12.34)})
    wanted = config(tmp_path, learners=("ours", "brax"), samples=60_000, train=("ppo.num_robots=64",))
    for _ in range(2):
        main(wanted)
    assert len(made) == 2
    ours, brax = json.loads((tmp_path / "out.json").read_text())["rows"]
    # The statistics of our inputs are of 50,000 states, in whole rollouts of 64 x 32.
    assert (ours["samples_to_150"], ours["train_s_to_150"]) == (2000 + 50_176, 20)
    assert (ours["samples_to_250"], ours["train_s_to_250"], ours["best_return_plain"]) == (4000 + 50_176, 40, 250.5)
    assert (brax["samples_to_150"], brax["train_s_to_250"], brax["best_return_plain"]) == (None, None, 12.34)
    console = Console(width=200)
    with console.capture() as shown:
        console.print(table([ours, brax]))
    lines = [re.split(r"\s*│\s*", line.strip("│ \n")) for line in shown.get().splitlines() if "seed" not in line]
    assert ["ours", "native 500 Hz", "0", "52,176", "20", "54,176", "40", "250.5", "54,176 samples, 40 s"] in lines
    assert ["brax", "mjx 1000 Hz", "0", *["not reached", ""] * 2, "12.3", "2,000 samples, 20 s"] in lines


@pytest.mark.parametrize("changes", [{"samples": 3000}, {"seconds": 7000}, {"train": ("ppo=massive",)}])
def test_a_run_with_another_budget_does_not_count(monkeypatch, tmp_path, changes):
    fake_runs(monkeypatch, {"brax-seed0": (1, 2)})
    learn("brax", 0, config(tmp_path))
    with pytest.raises(ValueError, match=r"brax-seed0\.json was made with .*; name another runs="):
        learn("brax", 0, config(tmp_path, **changes))


@pytest.mark.parametrize(
    ("budget", "returns", "over"),
    [
        ({}, (10, 249.9), False),
        ({}, (10, 250), True),
        ({"samples": 1999}, (10, 260), True),
        ({"samples": 2000}, (10, 20), False),
        ({"seconds": 19}, (10, 20), True),
    ],
)
def test_a_run_is_over_with_the_last_goal_or_its_budget(budget, returns, over):
    assert is_over(points(*returns), PeersConfig(**budget)) == over
    inside = budget.get("samples", 2000) >= 2000 and budget.get("seconds", 20) >= 20
    assert len(within(points(*returns), PeersConfig(**budget))) == 1 + inside


def test_each_learner_is_told_what_the_others_are(tmp_path):
    told = config(tmp_path, train=("ppo=massive", "evaluate_every=5"))
    told = {name: command(name, 3, tmp_path, told) for name in LEARNERS}
    for name, rate in (("ours", 500), ("sb3", 500), ("ours_mjx", 1000), ("brax", 1000)):
        assert told[name][:3] == [sys.executable, "-m", LEARNERS[name].module]
        assert {f"physics_hz={rate}", "seed=3", f"run_dir={tmp_path}"} <= set(told[name])
    assert {"physics=mjx", "ppo=massive", "resume=true"} <= set(told["ours_mjx"])
    # Ours is measured every 5 iterations of 4096 robots x 16 steps.
    assert {"robots=4096", "every=327680"} <= set(told["brax"])


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"learners": ("song",)}, "learners=song is not known; choose one of ours, sb3, ours_mjx, brax."),
        ({"seeds": ()}, "seeds is empty"),
        ({"train": ("ppo.gama=1",)}, "Did you mean"),
    ],
)
def test_bad_input_is_one_sentence(tmp_path, changes, sentence):
    with pytest.raises(ValueError, match=sentence):
        config(tmp_path, **changes)


def test_a_missing_package_is_told_before_any_run(monkeypatch, tmp_path):
    made = fake_runs(monkeypatch, {})
    monkeypatch.setattr(peers.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"learners=sb3 needs the package stable-baselines3; pip install .*\[peers\]"):
        main(config(tmp_path))
    assert not made


def test_a_run_that_fails_is_told(monkeypatch, tmp_path):
    monkeypatch.setattr(peers, "command", lambda *_: [sys.executable, "-c", "raise SystemExit(3)"])
    with pytest.raises(ValueError, match="ended with status 3"):
        learn("ours", 0, config(tmp_path))
    assert not list((tmp_path / "runs").iterdir())


def test_a_run_that_is_over_is_ended(monkeypatch, tmp_path):
    monkeypatch.setattr(peers, "command", lambda *_: [sys.executable, "-c", "import time; time.sleep(60)"])
    monkeypatch.setattr(peers, "read_curve", lambda *_: points(10, 250))
    assert row(learn("ours", 0, config(tmp_path)))["samples_to_250"] == 2000


def test_peers_are_measured_with_the_law_of_their_views(monkeypatch, tmp_path):
    measured = []
    monkeypatch.setattr(meter, "walk_returns", lambda agent, physics: measured.append(agent.law) or {})
    meter.Meter(meter.PeerConfig(run_dir=str(tmp_path))).measure(1, lambda network, observation: observation, None)
    law = make_env("1x", 1, "native").law
    assert law.symmetric
    assert [(each.observation, each.symmetric) for each in measured] == [(law.observation, law.symmetric)]


@pytest.mark.slow
@pytest.mark.parametrize("learner", LEARNERS)
def test_each_learner_learns_for_a_few_thousand_steps(monkeypatch, tmp_path, learner):
    if any(find_spec(package.replace("-", "_")) is None for package in LEARNERS[learner].packages):
        pytest.skip("the extra peers is not installed")
    monkeypatch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
    small = [each for each in tiny.ARGUMENTS if "iterations" not in each]
    # Ours ends after 3200 samples, and is measured as often as Brax with its iterations of 640; the third has 8192.
    few = (*small, "ppo.iterations=100", "evaluate_every=20")
    run = learn(learner, 0, config(tmp_path, samples=9000, train=few))
    assert len(run["curve"]) == {"ours": 5, "ours_mjx": 5, "brax": 14, "sb3": 1}[learner]
    assert all(0 < point["return_plain"] < 300 for point in run["curve"])
    seconds = [point["train_s"] for point in run["curve"]]
    assert seconds == sorted(seconds)
