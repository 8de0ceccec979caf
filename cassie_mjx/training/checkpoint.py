"""Checkpoints of whole runs: written by orbax, renamed into place when complete, checked byte by byte when read.

A checkpoint is a directory `step_<iteration>`:

    state/          every array of the run's state, by orbax, as NumPy arrays under their path in the state
    reference.npz   the reference motion
    record.json     configuration, counters, provenance
    manifest.json   size and SHA-256 of every other file; written last, with a digest of its own in manifest.sha256

A directory of any other name, such as one left by a save that was killed, is no checkpoint and is removed by the next
save.
"""

import errno
import json
import logging
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np
import orbax.checkpoint as ocp

from cassie_mjx import cli
from cassie_mjx.files import atomic
from cassie_mjx.motion.files import read_motion, save_motion
from cassie_mjx.motion.reference import ReferenceMotion
from cassie_mjx.training import manifest

KEPT = 2
"""Checkpoints kept: the last, and the one before it in case the last is damaged on disk."""

FORMAT = 1

_PREFIX = "step_"

T = TypeVar("T")


class Restored(NamedTuple):
    """A checkpoint read back."""

    arrays: dict[str, np.ndarray]
    """Arrays of the state by path; `restore_into` puts them into a state's structure."""
    motion: ReferenceMotion
    """The reference motion."""
    record: dict[str, Any]
    """What `save` was given."""
    iteration: int
    """After which it was saved."""


def save(directory: Path, iteration: int, state: Any, motion: ReferenceMotion, record: dict[str, Any]) -> Path:
    """Write a checkpoint whole or not at all, then remove all but the last `KEPT`, and any of a later iteration.

    Args:
      directory: of the run's checkpoints; made if missing.
      iteration: names the checkpoint.
      state: pytree of arrays.
      motion: what is imitated.
      record: anything JSON can hold.

    Returns:
      The checkpoint's directory.

    Raises:
      OSError: it cannot be written, for instance on a full disk; the checkpoints before it are as they were.
    """
    final = directory / f"{_PREFIX}{iteration:06d}"
    partial = directory / f"{final.name}.partial"
    try:
        directory.mkdir(parents=True, exist_ok=True)
        _remove_unfinished(directory)
        partial.mkdir()
        arrays = _flatten(state)
        _check_space(partial, arrays)
        _write_state(partial / "state", arrays)
        save_motion(partial / "reference.npz", motion, {})
        (partial / "record.json").write_text(json.dumps({"format": FORMAT, **record}, indent=1))
        manifest.write(partial)
        _sync(partial)
        # A run begins at its last whole checkpoint, so one of this iteration or a later one is damaged.
        for damaged in (old for old in _checkpoints(directory) if iteration_of(old) >= iteration):
            _discard(damaged)
        partial.rename(final)
        atomic.sync(directory)
    except OSError as error:
        shutil.rmtree(partial, ignore_errors=True)
        raise OSError(
            f"The checkpoint {final} could not be written ({error.strerror or error}); those before it are intact."
        ) from error
    for old in _checkpoints(directory)[:-KEPT]:
        _discard(old)
    return final


def latest(directory: Path) -> Path | None:
    """The last complete checkpoint in `directory`, if there is one."""
    return next(reversed(_checkpoints(directory)), None)


def iteration_of(checkpoint: Path) -> int:
    """The iteration after which a checkpoint was saved."""
    return int(checkpoint.name.removeprefix(_PREFIX))


def restore_last(
    directory: Path, check: Callable[[dict[str, Any]], object] = lambda record: None
) -> tuple[Restored | None, list[str]]:
    """The last checkpoint that is whole, and a sentence about each later one that is not; None without any checkpoint.

    Args:
      directory: of the run's checkpoints.
      check: raises ValueError for a record that a run cannot go on from.

    Raises:
      ValueError: there are checkpoints, and none of them is whole.
    """
    damaged: list[str] = []
    for checkpoint in reversed(_checkpoints(directory)):
        try:
            restored = restore(checkpoint)
        except ValueError as error:
            damaged.append(str(error))
            continue
        try:
            check(restored.record)
        except ValueError as error:
            damaged.append(f"{checkpoint} is damaged: {error}")
            continue
        return restored, damaged
    if damaged:
        raise ValueError(f"{directory} holds no checkpoint that is whole; choose another run_dir. {' '.join(damaged)}")
    return None, damaged


def restore(checkpoint: Path) -> Restored:
    """Read a checkpoint that any platform wrote.

    Raises:
      ValueError: a file is missing, unreadable, cut short, altered or added, named in the message; or the format is
        another.
    """
    try:
        manifest.check(checkpoint)
        record = cli.read_json(checkpoint / "record.json", f"{checkpoint.name} is damaged.")
        if record.pop("format", None) != FORMAT:
            raise ValueError(f"{checkpoint} is of another format than {FORMAT}, which this version reads.")
        motion, _ = read_motion(checkpoint / "reference.npz")
        return Restored(_read_state(checkpoint / "state"), motion, record, iteration_of(checkpoint))
    except OSError as error:
        raise ValueError(f"{checkpoint} cannot be read ({error}).") from error


def restore_into(template: T, arrays: dict[str, np.ndarray]) -> T:
    """The state `template` with the restored arrays in place of its own, each where, and in the precision that, it was.

    Raises:
      ValueError: an array is missing or has another shape.
    """

    def pick(path: Any, leaf: Any) -> Any:
        name = jax.tree_util.keystr(path)
        if np.size(leaf) == 0:
            return leaf
        if name not in arrays or arrays[name].shape != np.shape(leaf):
            found = f"has shape {arrays[name].shape}" if name in arrays else "is missing"
            raise ValueError(f"The checkpoint does not fit this run: {name} {found}, not of shape {np.shape(leaf)}.")
        if isinstance(leaf, jax.Array):
            return jax.device_put(arrays[name].astype(leaf.dtype), leaf.sharding)
        return arrays[name].astype(np.asarray(leaf).dtype)

    return jax.tree_util.tree_map_with_path(pick, template)


def _flatten(state: Any) -> dict[str, np.ndarray]:
    leaves = jax.tree_util.tree_leaves_with_path(state)
    # orbax writes no empty arrays; `restore_into` does without.
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in leaves if np.size(leaf)}


def _check_space(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Raise OSError if the disk is too full: in the middle of a save, orbax's threads would print their tracebacks."""
    # Each array is written twice, once by the process and once merged; 1 MB is more than all the rest takes.
    needed = 2 * sum(array.nbytes for array in arrays.values()) + 1_000_000
    if shutil.disk_usage(path).free < needed:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _write_state(path: Path, arrays: dict[str, np.ndarray]) -> None:
    # orbax logs the traceback of each of its threads, and then raises the error.
    orbax_log = logging.getLogger("absl")
    orbax_log.disabled = True
    try:
        with _checkpointer() as checkpointer:
            checkpointer.save(path.absolute(), args=ocp.args.StandardSave(arrays))
    except ValueError as error:
        # TensorStore reports the system's errors in this form.
        code = re.search(r"os_error_code='(\d+)'", str(error))
        if code is None:
            raise
        raise OSError(int(code[1]), os.strerror(int(code[1]))) from error
    finally:
        orbax_log.disabled = False


def _read_state(path: Path) -> dict[str, np.ndarray]:
    try:
        with _checkpointer() as checkpointer:
            restored = checkpointer.restore(path.absolute(), args=ocp.args.StandardRestore())
        return {name: np.asarray(value) for name, value in restored.items()}
    except Exception as error:  # orbax says in no one place what it raises
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ValueError(f"{path} cannot be read ({reason}).") from error


def _checkpointer() -> ocp.Checkpointer:
    # By itself, orbax would wait for the other processes of a training to make the same call.
    me = jax.process_index()
    alone = ocp.options.MultiprocessingOptions(primary_host=me, active_processes={me})
    return ocp.Checkpointer(ocp.StandardCheckpointHandler(multiprocessing_options=alone), multiprocessing_options=alone)


def _checkpoints(directory: Path) -> list[Path]:
    found = directory.iterdir() if directory.exists() else ()
    return sorted((path for path in found if re.fullmatch(f"{_PREFIX}[0-9]+", path.name)), key=iteration_of)


def _remove_unfinished(directory: Path) -> None:
    for path in directory.glob(f"{_PREFIX}*.partial"):
        shutil.rmtree(path, ignore_errors=True)


def _discard(checkpoint: Path) -> None:
    """Remove a checkpoint so that at no moment a part of it passes for one."""
    doomed = checkpoint.with_name(f"{checkpoint.name}.old.partial")
    checkpoint.rename(doomed)
    shutil.rmtree(doomed, ignore_errors=True)


def _sync(checkpoint: Path) -> None:
    for path in (*checkpoint.rglob("*"), checkpoint):
        atomic.sync(path)
