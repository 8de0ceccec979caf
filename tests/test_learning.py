"""Learning studies: which settings, which runs, and the figures by hand."""

import json
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace

import pytest

from cassie_mjx.envs.config import WALK_PRESETS
from cassie_mjx.training.config import TrainConfig
from cassie_mjx.training.run_directory import comparable
from experiments import learning
from experiments.learning import LearningConfig, main, summarize, to_goal
from experiments.studies import ACTOR, LATER, STUDIES, Variant, deviations, expected

RESULTS = Path(__file__).parents[1] / "experiments" / "results"
TWO_SEEDS = Variant("tenth", {"ppo": "paper", ACTOR: "1e-4", "walk.min_reward": "null"}, (0, 1))


def fake_training(monkeypatch, status=0, changed=None):
    """Instead of a training, the files of one: seed k returns 100 k + 200, 300 at 3000, 6000 samples."""
    calls = []

    def begin(command, env):
        calls.append(command)
        values = dict(argument.split("=") for argument in command[3:])
        folder = learning.Path(values["run_dir"])
        (folder / "checkpoints" / "step_000300").mkdir(parents=True)
        held = {"config": expected(TWO_SEEDS, int(values["seed"]), folder.parent) | (changed or {})}
        (folder / "config.json").write_text(json.dumps(held | {"provenance": {"commit": "abc"}}))
        rows = [dict.fromkeys(learning.COLUMNS.values(), 3000.0 * k) for k in (1, 2)]
        for k, row in enumerate(rows):
            row["eval/return_plain"], row["eval/return_weighted"] = 200 + 100 * k * int(values["seed"]), 10 * k
        (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
        return nullcontext(SimpleNamespace(wait=lambda: status))

    monkeypatch.setattr(learning, "subprocess", SimpleNamespace(Popen=begin))
    monkeypatch.setitem(STUDIES, "test", (TWO_SEEDS,))
    return calls


def study(folder):
    main(LearningConfig("test", str(folder / "runs"), str(folder / "out.json"), str(folder / "plot.png")))
    return json.loads((folder / "out.json").read_text())


def test_a_study_trains_each_seed_once_and_reports_it(monkeypatch, tmp_path):
    calls = fake_training(monkeypatch)
    result = study(tmp_path)
    assert [call[3:] for call in calls] == [
        [
            *("physics=native", "physics_hz=500", "evaluate_every=40"),
            *(f"{key}={value}" for key, value in TWO_SEEDS.settings.items()),
            *(f"seed={k}", f"run_dir={tmp_path}/runs/tenth-seed{k}", "resume=true"),
        ]
        for k in (0, 1)
    ]
    assert [run["samples_to_250_plain"] for run in result["runs"]] == [None, 6000]
    assert result["provenance"]["commits_of_the_runs"] == ["abc"]
    kept = result["rows"][0]
    # Best returns 200 and 300: mean 250, sample standard deviation 50 sqrt(2).
    assert (kept["quantity"], kept["mean"], kept["min"], kept["max"]) == ("return_plain", 250, 200, 300)
    assert kept["sd"] == pytest.approx(50 * 2**0.5)
    assert (tmp_path / "plot.png").stat().st_size > 1000

    study(tmp_path)
    assert len(calls) == 2, "finished runs are not repeated"


@pytest.mark.parametrize(("key", "value"), [("walk.min_reward", 0.6), ("physics_hz", 1000), ("physics", "mjx")])
def test_a_run_with_other_settings_is_not_reported(monkeypatch, tmp_path, key, value):
    fake_training(monkeypatch, changed={key: value})
    with pytest.raises(ValueError, match=f"was trained with {key}={value}, unlike tenth"):
        study(tmp_path)
    assert not (tmp_path / "out.json").exists()


def test_a_run_that_is_not_finished_is_not_reported(monkeypatch, tmp_path):
    fake_training(monkeypatch)
    study(tmp_path)
    checkpoints = tmp_path / "runs" / "tenth-seed1" / "checkpoints"
    (checkpoints / "step_000300").rename(checkpoints / "step_000290")
    with pytest.raises(ValueError, match="tenth-seed1 holds no finished training"):
        learning.check(checkpoints.parent, TWO_SEEDS, 1)


def test_the_return_is_that_of_the_last_policy(tmp_path):
    variant = Variant("one", {}, (0,))
    config = expected(variant, 0, tmp_path.parent)
    (tmp_path / "checkpoints" / f"step_{config['ppo.iterations']:06}").mkdir(parents=True)
    (tmp_path / "config.json").write_text(json.dumps({"config": config}))
    returns = [(295, 200), (290, 250), (280, 240)]
    lines = [dict.fromkeys(learning.COLUMNS.values(), 0.0) for _ in returns]
    for line, (plain, weighted) in zip(lines, returns, strict=True):
        line |= {"eval/return_plain": plain, "eval/return_weighted": weighted}
    without = {name: value for name, value in lines[0].items() if not name.startswith("eval/")}
    written = [*lines[:2], without, lines[2], without]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in written))
    found = learning.read(tmp_path, variant, 0)
    assert (found["return_plain"], found["return_weighted"]) == (280, 240)
    assert len(found["curve"]["samples"]) == 3


@pytest.mark.parametrize("key", LATER)
def test_a_run_made_before_a_setting_existed_is_one_without_it(monkeypatch, tmp_path, key):
    fake_training(monkeypatch)
    study(tmp_path)
    path = tmp_path / "runs" / "tenth-seed1" / "config.json"
    held = json.loads(path.read_text())
    without = expected(TWO_SEEDS, 1, path.parent.parent)[key] == LATER[key]
    del held["config"][key]
    path.write_text(json.dumps(held))
    if without:
        study(tmp_path)
    else:
        with pytest.raises(ValueError, match=f"was trained with {key}={LATER[key]}, unlike tenth"):
            study(tmp_path)


def test_a_training_that_fails_ends_the_study(monkeypatch, tmp_path):
    fake_training(monkeypatch, status=130)
    with pytest.raises(ValueError, match="tenth-seed0 ended with status 130; the same command goes on from there."):
        study(tmp_path)


def test_the_goal_is_reached_at_the_first_evaluation_at_or_over_it():
    curve = {"samples": [10.0, 20.0, 30.0, 40.0], "return_plain": [249.9, 250.0, 100.0, 290.0]}
    assert to_goal(curve, "plain", "samples") == 20
    assert to_goal({"samples": [10.0], "return_plain": [249.9]}, "plain", "samples") is None


def test_what_is_never_reached_has_no_mean():
    quantities = [f"{name}_{reward}" for name in ("return", "samples_to_250") for reward in ("plain", "weighted")]
    run = dict.fromkeys([*quantities, "train_s_to_250_plain", "train_s_to_250_weighted"]) | {"physics_hz": 500}
    rows = summarize(TWO_SEEDS, [run, run | {"samples_to_250_plain": 7.0}])
    assert {row["quantity"]: row["mean"] for row in rows if row["n"]} == {"samples_to_250_plain": 7.0}
    assert {row["runs"] for row in rows} == {2}


def test_studies_fix_settings_that_exist_and_share_runs_by_name():
    seen = {}
    for variant in (variant for variants in STUDIES.values() for variant in variants):
        assert expected(variant, 0, learning.Path("runs")).keys() == comparable(asdict(TrainConfig())).keys()
        assert seen.setdefault(variant.name, variant.settings) == variant.settings


def test_overrides_read_as_a_run_records_them():
    wanted = expected(TWO_SEEDS, 1, learning.Path("runs"))
    assert wanted["seed"] == 1
    assert wanted["ppo.critic_learning_rate"] == 1e-2
    assert wanted["ppo.actor_learning_rate"] == 1e-4
    assert wanted["walk.min_reward"] is None
    assert wanted["ppo.hidden_sizes"] == [256, 256]


def test_a_run_can_go_on_from_the_one_of_its_seed_in_a_task_of_its_own():
    on = Variant("on", {"walk": "robust", "init": "{runs}/first-seed{seed}", "walk.kd_scale": "0.5"})
    wanted = expected(on, 2, learning.Path("other/runs"))
    assert (wanted["init"], wanted["seed"], wanted["walk.kd_scale"]) == ("other/runs/first-seed2", 2, 0.5)
    assert wanted["walk.scenario.push_n"] == WALK_PRESETS["robust"].scenario.push_n > 0


def test_an_unknown_study_is_refused():
    known = "walking, make_train, learning_speeds, starts, changes, .*, paper"
    with pytest.raises(ValueError, match=f"study=song is not known; choose one of {known}"):
        LearningConfig("song")


@pytest.mark.parametrize("study", sorted(path.stem for path in RESULTS.glob("*.json") if path.stem in STUDIES))
def test_what_was_measured_is_what_the_study_is_now(study):
    runs = json.loads((RESULTS / f"{study}.json").read_text())["runs"]
    assert [(run["variant"], run["seed"]) for run in runs] == [(v.name, s) for v in STUDIES[study] for s in v.seeds]
    variants = {variant.name: variant for variant in STUDIES[study]}
    for run in runs:
        assert not deviations(run["config"], variants[run["variant"]], run["seed"], Path("runs/studies"))


def test_a_study_that_is_told_to_end_tells_its_training(monkeypatch, tmp_path):
    told = []

    def wait():
        raise SystemExit(143)

    training = nullcontext(SimpleNamespace(wait=wait, terminate=lambda: told.append("SIGTERM")))
    monkeypatch.setattr(learning, "subprocess", SimpleNamespace(Popen=lambda _, env: training))
    with pytest.raises(SystemExit):
        learning.train(tmp_path / "run", TWO_SEEDS, 0)
    assert told == ["SIGTERM"]
