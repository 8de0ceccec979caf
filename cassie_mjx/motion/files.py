"""Motion files: our own .npz, and the public trajectories of Cassie; read, checked and written."""

import json
import zipfile
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from cassie_mjx.motion.checks import ARRAYS, check_arrays, check_motion
from cassie_mjx.motion.reference import ReferenceMotion, aligned, mix_qpos
from cassie_mjx.robot import cassie
from cassie_mjx.robot.cassie import CONTROL_PERIOD_S

SHIPPED = ("walk",)

_FORMAT, _VERSION = "cassie-mjx reference motion", 1

# The public trajectory file: time, qpos, qvel, then motor torques, positions and velocities, 10 each.
_COLUMNS = 98
_TIME, _QPOS, _QVEL = 0, slice(1, 36), slice(36, 68)

_NOT_PERIODIC_RAD = 0.1
_LONGEST_STRIDE_S = 10.0


def load_motion(name_or_path: str) -> ReferenceMotion:
    """The motion of that name that we ship, of an .npz file (`read_motion`), or of a public one (`read_trajectory`).

    Raises:
      ValueError: no such name or file, or a file that holds no motion of Cassie.
    """
    if name_or_path in SHIPPED:
        return read_motion(shipped_path(name_or_path))[0]
    path = Path(name_or_path)
    if not path.is_file():
        raise ValueError(f"reference={name_or_path!r} is neither {', '.join(SHIPPED)} nor a file.")
    motion = aligned(read_motion(path)[0] if path.suffix == ".npz" else read_trajectory(path))
    check_motion(motion, path)
    return motion


def shipped_path(name: str) -> Path:
    """The file of a motion in `SHIPPED`."""
    return Path(str(files("cassie_mjx"))) / "motion" / f"{name}.npz"


def save_motion(path: Path, motion: ReferenceMotion, provenance: dict[str, Any]) -> None:
    """Write `motion` and where it came from to `path`, whole or not at all."""
    content: dict[str, Any] = {name: np.asarray(getattr(motion, name), np.float64) for name in ARRAYS}
    content |= {"periodic": motion.periodic}
    content |= {"format": _FORMAT, "version": _VERSION, "provenance": json.dumps(provenance)}
    partial = path.with_name(path.name + ".partial")
    with partial.open("wb") as file:
        np.savez(file, **content)
    partial.replace(path)


def read_motion(path: Path) -> tuple[ReferenceMotion, dict[str, Any]]:
    """Read what `save_motion` wrote: the motion, in NumPy float64, and its provenance.

    Raises:
      ValueError: the file is not readable, not of this format and version, or not a motion of Cassie.
    """
    names = ("format", "version", "provenance", *ARRAYS)
    try:
        with np.load(path, allow_pickle=False) as content:
            found = {name: np.asarray(content[name]) for name in names if name in content}
            # Files from before motions that end have no such entry.
            periodic = bool(content["periodic"]) if "periodic" in content else True
        if len(found) < len(names) or str(found["format"]) != _FORMAT:
            raise ValueError(f"it is not a {_FORMAT}; experiments.record_reference makes one.")
        version, provenance = int(found["version"]), json.loads(str(found["provenance"]))
    except (OSError, EOFError, TypeError, ValueError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} cannot be read: {error}") from error
    if version != _VERSION:
        raise ValueError(f"{path} has version {version} of the format; this program reads version {_VERSION}.")
    motion = ReferenceMotion(found["qpos"], found["qvel"], found["stride_length"], periodic)
    check_arrays(motion, path)
    return motion, provenance


def read_trajectory(path: Path) -> ReferenceMotion:
    """Read one stride of a public Cassie trajectory: rows of 98 little-endian float64, the last repeating the first.

    The stride is resampled to the nearest whole number of samples of 32 ms, and its velocities follow the change of
    pace: the published 0.84 s, 26.25 samples, become 26 samples, 0.832 s, at velocities 0.84 / 0.832 as high.

    Raises:
      ValueError: the file is cut short, no stride, or no motion of Cassie.
    """
    content = path.read_bytes()
    row_size = 8 * _COLUMNS
    if not content or len(content) % row_size:
        raise ValueError(
            f"{path} has {len(content)} bytes, no whole number of rows of {row_size}: "
            "it is cut short or not a Cassie trajectory."
        )
    rows = np.frombuffer(content, "<f8").reshape(-1, _COLUMNS)
    time, qpos, qvel = rows[:, _TIME], rows[:, _QPOS], rows[:, _QVEL]
    recorded = ReferenceMotion(qpos, qvel, qpos[-1, cassie.PELVIS_X] - qpos[0, cassie.PELVIS_X])
    check_arrays(recorded, path)
    qpos = aligned(recorded).qpos
    duration = time[-1] - time[0]
    if not (np.diff(time) > 0).all() or not 2 * CONTROL_PERIOD_S <= duration <= _LONGEST_STRIDE_S:
        raise ValueError(
            f"{path} is not a stride: its first column, time, must rise with each row, "
            f"by 0.064 to {_LONGEST_STRIDE_S:g} s in all."
        )
    gap = np.abs(np.delete(qpos[-1] - qpos[0], cassie.PELVIS_X)).max()
    if gap > _NOT_PERIODIC_RAD:
        raise ValueError(
            f"{path} is not a stride: its last row must repeat the first besides x, and is off by {gap:.3g}."
        )

    samples = round(duration / CONTROL_PERIOD_S)
    row = np.interp(np.arange(samples) * duration / samples, time - time[0], np.arange(len(time)))
    before = row.astype(int)
    share = (row - before)[:, None]
    resampled = mix_qpos(qpos[before + 1], qpos[before], share)
    resampled[:, cassie.PELVIS_X] -= qpos[0, cassie.PELVIS_X]
    # q'(t) = q(t T / T'), so qdot' = qdot T / T' with T' = N 0.032 s
    pace = duration / (samples * CONTROL_PERIOD_S)
    velocity = pace * (share * qvel[before + 1] + (1 - share) * qvel[before])
    return ReferenceMotion(resampled, velocity, qpos[-1, cassie.PELVIS_X] - qpos[0, cassie.PELVIS_X])
