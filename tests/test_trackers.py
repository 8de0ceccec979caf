"""Where a run's numbers and films go."""

import json
from dataclasses import replace

import pytest
from tiny import config, session

from cassie_mjx.training import config as training_config
from cassie_mjx.training import loggers, runner, trackers
from cassie_mjx.training.config import TrainConfig, resolve_config


def run(folder, **changes):
    session(folder, **changes).train()
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def test_a_tracker_that_is_not_known_or_not_installed_is_refused(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="log=jsonl,wandbb is not known; choose one of .* Did you mean wandb"):
        TrainConfig(log=("jsonl", "wandbb"))

    def missing(name):
        raise ImportError(name)

    monkeypatch.setattr(trackers.importlib, "import_module", missing)
    with pytest.raises(
        ValueError, match=r"log=mlflow needs a package that is not here: pip install 'cassie-mjx\[mlflow\]'"
    ):
        resolve_config(config(tmp_path / "run", log=("mlflow",)))
    assert not (tmp_path / "run").exists()


def test_what_is_logged_can_change_when_a_run_goes_on(tmp_path):
    first = config(tmp_path / "run", log=())
    session(tmp_path / "run", log=()).train()
    assert not (tmp_path / "run" / "metrics.jsonl").exists()
    more = replace(first.ppo, iterations=4)
    lines = run(tmp_path / "run", ppo=more, resume=True)
    assert [line["train/iteration"] for line in lines] == [4]


def test_a_film_that_cannot_be_drawn_does_not_end_the_run(tmp_path, monkeypatch):
    def fail(path, agent, electronics):
        raise ValueError("nothing can draw here")

    monkeypatch.setattr(runner, "film_policy", fail)
    monkeypatch.setattr(training_config, "choose_backend", lambda: None)
    lines = run(tmp_path / "run", video_every=1)
    assert [line["train/iteration"] for line in lines] == [2]


@pytest.mark.slow
def test_films_go_to_tensorboard(tmp_path):
    session(tmp_path / "run", video_every=1).train()
    film = (tmp_path / "run" / "films" / "000002.gif").read_bytes()
    (events,) = (tmp_path / "run" / "tensorboard").glob("events*")
    assert film.startswith(b"GIF8")
    assert film in events.read_bytes()


@pytest.mark.slow
def test_mlflow_has_the_numbers_the_settings_and_the_films_of_a_resumed_run(tmp_path, monkeypatch):
    mlflow = pytest.importorskip("mlflow")
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    folder, log = tmp_path / "run", ("jsonl", "mlflow")
    run(folder, log=log, video_every=1)
    more = replace(config(folder).ppo, iterations=4)
    lines = run(folder, log=log, ppo=more, resume=True)
    client = mlflow.MlflowClient(f"sqlite:///{tmp_path / 'mlflow.db'}")
    (found,) = client.search_runs([client.get_experiment_by_name("cassie-mjx").experiment_id])
    history = client.get_metric_history(found.info.run_id, "eval/return_plain")
    assert [(each.step, each.value) for each in history] == [
        (line["train/samples"], line["eval/return_plain"]) for line in lines
    ]
    assert found.data.params["ppo.num_robots"] == "4"
    assert found.info.status == "FINISHED"
    assert [each.path for each in client.list_artifacts(found.info.run_id, "films")] == ["films/000002.gif"]


@pytest.mark.slow
def test_wandb_keeps_a_run_offline(tmp_path, monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    folder = tmp_path / "run"
    run(folder, log=("jsonl", "wandb"), video_every=1)
    (kept,) = folder.glob("wandb/offline-run-*")
    assert kept.name.endswith((folder / "wandb.id").read_text())
    content = b"".join(path.read_bytes() for path in kept.rglob("*") if path.is_file())
    assert b"eval/return_plain" in content
    assert list(kept.rglob("*.gif"))


class Broken(loggers.JsonLines):
    def write(self, values):
        raise RuntimeError("the network is down\nand more")


def test_a_tracker_that_fails_does_not_end_the_run(tmp_path, monkeypatch):
    monkeypatch.setattr(loggers, "TRACKERS", {"wandb": lambda folder, config: Broken(folder / "broken", 0)})
    said = []
    sinks = loggers.Sinks(tmp_path, TrainConfig(log=("wandb", "jsonl")), 0, said.append)
    for _ in range(2):
        sinks.write({"train/samples": 1})
    assert said == ["Broken failed and gets nothing more of this run: the network is down"]
    assert len((tmp_path / "metrics.jsonl").read_text().splitlines()) == 2


def test_a_tracker_that_does_not_start_is_told_in_a_sentence(tmp_path, monkeypatch):
    def refuse(folder, config):
        raise RuntimeError("no API key")

    monkeypatch.setattr(loggers, "TRACKERS", {"wandb": refuse})
    with pytest.raises(ValueError, match="log=wandb does not start: no API key"):
        loggers.Sinks(tmp_path, TrainConfig(log=("wandb",)), 0, print)
