"""Who may write into a run's directory: a new run, or the one that is there already and wants to go on."""

import json
import shlex
import sys
import zlib
from dataclasses import asdict
from pathlib import Path
from typing import Any

from cassie_mjx import cli
from cassie_mjx.training import checkpoint, devices
from cassie_mjx.training.config import TrainConfig, present_names


def claim(
    folder: Path, config: TrainConfig, provenance: dict[str, Any]
) -> tuple[checkpoint.Restored | None, list[str]]:
    """Take the run directory for a resolved configuration, and read its last whole checkpoint if the run is to go on.

    Returns:
      The checkpoint, if there is one, and sentences that its user should read: damaged checkpoints, other versions.

    Raises:
      ValueError: it holds a run already and `resume` is not set, or another run, or files of something else to resume;
        or the hosts do not share it.
      OSError: it cannot be written.
    """
    wanted = comparable(asdict(config))
    found = _look(folder, wanted, config.resume)
    # No process writes before all have looked.
    if len(set(devices.exchange(zlib.crc32(str(found).encode())))) > 1:
        raise ValueError(f"{folder} is not the same directory on all hosts; choose a run_dir that they share.")
    if devices.is_first() and not (folder / "config.json").exists():
        _begin(folder, {"config": wanted, "provenance": provenance})
    if not found:
        return None, []
    restored, damaged = checkpoint.restore_last(folder / "checkpoints")
    notes = [f"{sentence} The run goes on from the checkpoint before it." for sentence in damaged]
    if restored:
        notes += changes(restored.record.get("provenance", {}), provenance)
    return restored, notes


def changes(before: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """A sentence about what a run was begun with and does not go on with: commit, Python, packages."""
    pairs = [("commit", before.get("commit"), now["commit"]), ("Python", before.get("python"), now["python"])]
    versions = before.get("versions", {})
    pairs += [(name, versions.get(name), version) for name, version in now["versions"].items()]
    differing = [f"{name} {old} then, {new} now" for name, old, new in pairs if old not in (None, new)]
    return [f"The run was begun with other software: {'; '.join(differing)}."] if differing else []


def resume_command() -> str:
    """The present command, with resume=true."""
    arguments = [argument for argument in sys.argv[1:] if not argument.startswith("resume=")]
    return shlex.join([*cli.program("cassie_mjx.train"), *arguments, "resume=true"])


def _look(folder: Path, wanted: dict[str, Any], resume: bool) -> Path | None:
    """The checkpoint to go on from, if there is one. Raise ValueError if the directory belongs to something else."""
    path = folder / "config.json"
    if not path.exists():
        # A job that a cluster starts again has the same command the first time.
        if resume and folder.exists() and any(folder.iterdir()):
            raise ValueError(f"{folder} holds files, but no run to resume; choose another run_dir.")
        return None
    held = _held(path)
    if unshared := sorted(held.keys() ^ wanted.keys()):
        raise ValueError(
            f"{folder} holds a run of another version of this program, with other settings ({', '.join(unshared)}); "
            "choose another run_dir."
        )
    if held != wanted:
        differing = [f"{key}={held[key]}" for key in wanted if held[key] != wanted[key]]
        raise ValueError(f"{folder} holds another run, with {', '.join(differing)}; choose another run_dir.")
    if not resume:
        raise ValueError(f"{folder} holds this run already; to go on with it: {resume_command()}")
    return checkpoint.latest(folder / "checkpoints")


def _begin(folder: Path, content: dict[str, Any]) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        cli.write_json(folder / "config.json", content)
    except OSError as error:
        raise OSError(f"The run directory {folder} cannot be written ({error.strerror or error}).") from error


def _held(path: Path) -> dict[str, Any]:
    try:
        return present_names(json.loads(path.read_text())["config"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} cannot be read ({error}); choose another run_dir.") from error


def comparable(config: dict[str, Any]) -> dict[str, Any]:
    """What makes a run the run it is, flat and as JSON gives it back."""
    kept = {name: value for name, value in _flat(config).items() if name not in ("resume", "run_dir", "distributed")}
    return json.loads(json.dumps(kept))


def _flat(config: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat = {}
    for name, value in config.items():
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return flat
