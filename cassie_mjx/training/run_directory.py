"""Who may write into a run's directory: a new run, or the one that is there already and wants to go on.

`config.json` holds the configuration that the run has now, the provenance of its beginning, the digest of the policy it
began with, and the changes of its configuration since, each with the iteration after which it was made.
"""

import hashlib
import json
import re
import shlex
import sys
import zlib
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cassie_mjx import cli
from cassie_mjx.agents.shipped import policy_path
from cassie_mjx.control.law import ControlLaw
from cassie_mjx.motion.command import speed_factors
from cassie_mjx.motion.files import SHIPPED, load_motion
from cassie_mjx.motion.reference import ReferenceMotion, stretch
from cassie_mjx.physics.make import ENGINES
from cassie_mjx.training import checkpoint, counters, devices, lock
from cassie_mjx.training.config import TrainConfig, flat, present_names

_NO_PART = ("resume", "run_dir", "distributed", "log", "video_every")
OWN = ("checkpoints", "metrics.jsonl", "best.npz", "last.npz", "tensorboard", "films", "nan")
"""What a run writes besides its configuration."""

CONFIG = "config.json"

# What a start that was cut short leaves, and what is there while a run is: neither makes a directory somebody's.
_NOBODYS = re.compile(rf"{re.escape(CONFIG)}(\.[0-9a-f]{{8}})?\.partial|{re.escape(lock.NAME)}")


class Claim(NamedTuple):
    """What a run begins or goes on with."""

    restored: checkpoint.Restored | None
    """Its last whole checkpoint; None for a run that begins."""
    motion: ReferenceMotion
    """What is imitated."""
    law: ControlLaw
    """The law that the policy learns."""
    notes: list[str]
    """Sentences that its user should read: damaged checkpoints, other versions, changes."""


def claim(folder: Path, config: TrainConfig, provenance: dict[str, Any]) -> Claim:
    """Take the run directory for a resolved configuration, and read its last whole checkpoint if the run is to go on.

    Raises:
      ValueError: it holds a run already and `resume` is not set, or another run, or files of something else to resume,
        or a run without its checkpoints; the reference is missing, another, or does not mirror its steps as the task
        needs; or the hosts do not share the directory.
      OSError: it cannot be written.
    """
    held, wanted = _look(folder, config.resume), comparable(asdict(config))
    found = checkpoint.latest(folder / "checkpoints") if held else None
    if held:
        _check_same(folder, held, wanted, config.resume, found is not None)
        if found is None:
            _check_nothing_lost(folder)
    # No process writes before all have looked.
    if len(set(devices.exchange(zlib.crc32(str(found).encode())))) > 1:
        raise ValueError(f"{folder} is not the same directory on all hosts; choose a run_dir that they share.")
    restored, damaged = checkpoint.restore_last(folder / "checkpoints", counters.from_record) if held else (None, [])
    motion, notes = _motion(config, held, restored)
    law = config.walk.law(motion)
    notes = [*(f"{sentence} The run goes on from the checkpoint before it." for sentence in damaged), *notes]
    if held is None:
        digest = {} if config.init is None else {"init_sha256": _policy_digest(config.init)}
        held = {"config": wanted, "provenance": provenance, **digest}
        if devices.is_first():
            _write(folder, held)
    elif not restored:
        notes.append(f"{folder} holds a run without a checkpoint yet, which begins anew.")
    if restored:
        notes += changes(held.get("provenance", {}), provenance)
    return Claim(restored, motion, law, notes + _change(folder, held, wanted, restored.iteration if restored else 0))


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


def comparable(config: dict[str, Any]) -> dict[str, Any]:
    """What makes a run the run it is, flat and as JSON gives it back."""
    kept = {name: value for name, value in flat(config).items() if name not in _NO_PART}
    return json.loads(json.dumps(kept))


def _look(folder: Path, resume: bool) -> dict[str, Any] | None:
    """What the directory's `config.json` holds; None if there is no run. Raise ValueError if it is somebody else's."""
    path = folder / CONFIG
    if path.exists():
        held = cli.read_json(path, "choose another run_dir.")
        provenance = held.get("provenance", {})
        parts = (held.get("config"), provenance, isinstance(provenance, dict) and provenance.get("versions", {}))
        if not all(isinstance(part, dict) for part in parts) or not isinstance(held.get("changes", []), list):
            raise ValueError(f"{path} cannot be read (it holds no configuration of a run); choose another run_dir.")
        return held | {"config": present_names(held["config"])}
    names = {each.name for each in folder.iterdir()} if folder.is_dir() else set()
    there = {name for name in names if not _NOBODYS.fullmatch(name)}
    # A job that a cluster starts again has the same command the first time.
    if resume and there:
        raise ValueError(f"{folder} holds files, but no run to resume; choose another run_dir.")
    if remains := sorted(there.intersection(OWN)):
        raise ValueError(
            f"{folder} holds {' and '.join(remains)} of a run whose {CONFIG} is missing; choose another run_dir."
        )
    return None


def _check_same(folder: Path, held: dict[str, Any], wanted: dict[str, Any], resume: bool, begun: bool) -> None:
    """Raise ValueError unless the run in the directory is the wanted one, and is to go on."""
    before = held["config"]
    if unshared := sorted(before.keys() ^ wanted.keys()):
        raise ValueError(
            f"{folder} holds a run of another version of this program, with other settings ({', '.join(unshared)}); "
            "choose another run_dir."
        )
    differing = {key for key in wanted if before[key] != wanted[key]}
    if resume:
        differing -= {key for key in differing if _may_change(key, held, wanted[key], begun)}
    engine = ENGINES.get(str(before["physics"]))
    if {"physics", "physics_hz"} <= differing and engine and engine.training.physics_hz == before["physics_hz"]:
        differing.remove("physics_hz")  # it follows from the engine
    if differing:
        settings = [_argument(key, before[key]) for key in wanted if key in differing]
        raise ValueError(
            f"{folder} holds another run, with {', '.join(settings)}; choose another run_dir, or go on with that run "
            f"by adding {shlex.join(settings)} resume=true"
        )
    if not resume:
        raise ValueError(f"{folder} holds this run already; to go on with it: {resume_command()}")


def _may_change(key: str, held: dict[str, Any], value: Any, begun: bool) -> bool:
    """Whether a run may go on with another value of this key; a file may have moved, and `_motion` compares motions."""
    if key == "init" and begun and value is not None:
        return "init_sha256" in held and held["init_sha256"] == _policy_digest(value)
    if key == "ppo.iterations":
        return isinstance(held["config"][key], int) and value > held["config"][key]
    if key == "walk.symmetric":
        return held["config"][key] is True and value is None  # the same, for only motions that mirror were let through
    return key == "evaluate_every" or (key == "reference" and begun)


def _policy_digest(init: str) -> str | None:
    path = policy_path(init)
    return hashlib.sha256(path.read_bytes()).hexdigest() if path else None


def _argument(key: str, value: Any) -> str:
    """A setting as a command line has it."""
    return f"{key}={value}" if isinstance(value, str) else f"{key}={json.dumps(value, separators=(',', ':'))}"


def _check_nothing_lost(folder: Path) -> None:
    """Raise ValueError if a run without a checkpoint has results: every run has a checkpoint before it has any."""
    results = (folder / name for name in ("metrics.jsonl", "best.npz", "last.npz"))
    if kept := [path.name for path in results if path.exists() and path.stat().st_size]:
        also = f" (init={folder} takes its best policy along)" if "best.npz" in kept else ""
        raise ValueError(
            f"{folder} holds {' and '.join(kept)} of a run, but no checkpoint to go on from; put its checkpoints back, "
            f"or choose another run_dir to begin anew{also}."
        )


def _motion(
    config: TrainConfig, held: dict[str, Any] | None, restored: checkpoint.Restored | None
) -> tuple[ReferenceMotion, list[str]]:
    """What is imitated: the reference, or what the checkpoint has of it if its file has moved.

    Raises:
      ValueError: there is no such reference, or it is another than the checkpoint's.
    """
    asked = config.reference
    here = asked in SHIPPED or Path(asked).is_file()
    if held and restored and not here and held["config"]["reference"] == asked:
        return restored.motion, [f"reference={asked} is not here: the run goes on with the motion in its checkpoint."]
    motion = stretch(load_motion(asked), speed_factors(config.speed)[0])
    if restored and not _same_motion(motion, restored.motion):
        raise ValueError(
            f"reference={asked} is another motion than the one in the checkpoints of {config.run_dir}; give the file "
            "that the run was begun with, or choose another run_dir."
        )
    return restored.motion if restored else motion, []


def _same_motion(one: ReferenceMotion, other: ReferenceMotion) -> bool:
    pairs = list(zip(one, other, strict=True))
    return all(np.shape(a) == np.shape(b) and np.allclose(a, b, rtol=0, atol=1e-9) for a, b in pairs)


def _change(folder: Path, held: dict[str, Any], wanted: dict[str, Any], iteration: int) -> list[str]:
    """Record how the configuration changes after that iteration; sentences about it."""
    before = held["config"]
    # Where the files of a run are is no part of it.
    changed = {key: wanted[key] for key in wanted if before[key] != wanted[key] and key not in ("reference", "init")}
    if not changed:
        return []
    change = {"iteration": iteration, "from": {key: before[key] for key in changed}, "to": changed}
    if devices.is_first():
        _write(folder, held | {"config": before | changed, "changes": [*held.get("changes", []), change]})
    said = [f"{_argument(key, value)} instead of {before[key]}" for key, value in changed.items()]
    schedules = "; schedules count to the new total" if "ppo.iterations" in changed else ""
    return [f"From iteration {iteration} on: {', '.join(said)}{schedules}."]


def _write(folder: Path, content: dict[str, Any]) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OSError(f"The run directory {folder} cannot be written ({error.strerror or error}).") from error
    cli.write_json(folder / CONFIG, content)
