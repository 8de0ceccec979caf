"""Where else a run's numbers and films can go: Weights & Biases and MLflow, an extra of this package each."""

import importlib
import time
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any

PROJECT = "cassie-mjx"


class Wandb:
    """Weights & Biases; `WANDB_MODE=offline` keeps all of it in the run's directory."""

    def __init__(self, folder: Path, config: Mapping[str, Any]) -> None:
        """Begin a run of the folder's name, or go on with that which the folder had."""
        self._wandb = _imported("wandb")
        settings = {"id": _identity(folder / "wandb.id"), "resume": "allow"}
        self._run = self._wandb.init(
            project=PROJECT, name=folder.name, dir=str(folder), config=dict(config), **settings
        )

    def write(self, values: Mapping[str, float]) -> None:
        """Log values over samples."""
        self._run.log(dict(values), step=int(values["train/samples"]))

    def film(self, path: Path, samples: int) -> None:
        """Log a film."""
        self._run.log({"film": self._wandb.Video(str(path), format=path.suffix[1:])}, step=samples)

    def close(self, finished: bool) -> None:
        """End the run."""
        self._run.finish(exit_code=0 if finished else 1)


class MLflow:
    """MLflow; without `MLFLOW_TRACKING_URI` in mlflow.db and, for films, mlruns/ beside the run's directory."""

    def __init__(self, folder: Path, config: Mapping[str, Any]) -> None:
        """Begin a run of the folder's name, or go on with that which the folder had."""
        mlflow = _imported("mlflow")
        place = None
        if not mlflow.environment_variables.MLFLOW_TRACKING_URI.is_set():
            mlflow.set_tracking_uri(f"sqlite:///{folder.parent.absolute() / 'mlflow.db'}")
            place = (folder.parent.absolute() / "mlruns").as_uri()
        self._client, self._entities = mlflow.MlflowClient(), mlflow.entities
        held = folder / "mlflow.id"
        if held.exists():
            self._id = held.read_text()
            self._client.update_run(self._id, status="RUNNING")
        else:
            experiment = self._client.get_experiment_by_name(PROJECT)
            found = experiment.experiment_id if experiment else self._client.create_experiment(PROJECT, place)
            self._id = self._client.create_run(found, run_name=folder.name).info.run_id
            held.write_text(self._id)
            for name, value in config.items():
                self._client.log_param(self._id, name, value)

    def write(self, values: Mapping[str, float]) -> None:
        """Log values over samples."""
        step, now = int(values["train/samples"]), round(1000 * time.time())
        metrics = [self._entities.Metric(name, float(value), now, step) for name, value in values.items()]
        self._client.log_batch(self._id, metrics)

    def film(self, path: Path, samples: int) -> None:
        """Keep a film."""
        self._client.log_artifact(self._id, str(path), "films")

    def close(self, finished: bool) -> None:
        """End the run."""
        self._client.set_terminated(self._id, "FINISHED" if finished else "KILLED")


TRACKERS = {"wandb": Wandb, "mlflow": MLflow}
"""Trackers by the name that `log=` gives them."""


def check_installed(names: tuple[str, ...]) -> None:
    """Raise ValueError if one of the trackers named is not installed."""
    for name in names:
        if name in TRACKERS:
            _imported(name)


def _imported(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ValueError(f"log={name} needs a package that is not here: pip install 'cassie-mjx[{name}]'.") from error


def _identity(path: Path) -> str:
    """The name that a tracker knows a run by, kept in a file of the run's directory."""
    if not path.exists():
        path.write_text(uuid.uuid4().hex)
    return path.read_text()
