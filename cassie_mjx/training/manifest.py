"""The list of a folder's files by which it is known to be as it was written: size and SHA-256 of each, and of the list.

`sha256sum --check manifest.sha256` checks the list, too. Folders from before it had a digest are checked without.
"""

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cassie_mjx import cli

MANIFEST, DIGEST = "manifest.json", "manifest.sha256"


def write(folder: Path) -> None:
    """Write the manifest of all files in `folder`; call it last.

    Raises:
      OSError: a file cannot be read or written.
    """
    entries = {name: {"bytes": path.stat().st_size, "sha256": _sha256(path)} for name, path in _files(folder)}
    (folder / MANIFEST).write_text(json.dumps(entries, indent=1))
    (folder / DIGEST).write_text(f"{_sha256(folder / MANIFEST)}  {MANIFEST}\n")


def check(folder: Path) -> None:
    """Compare every file in `folder`, and which there are, with the manifest.

    Raises:
      ValueError: one is missing, added, cut short or altered, the manifest included; the message names it.
      OSError: one cannot be read.
    """
    damaged, found = f"{folder.name} is damaged.", dict(_files(folder))
    entries = _entries(folder, damaged)
    for name in sorted(entries.keys() | found.keys()):
        path = folder / name
        if name not in found:
            raise ValueError(f"{path} is missing; {damaged}")
        if name not in entries:
            raise ValueError(f"{path} is not in the manifest; {damaged}")
        size, expected = path.stat().st_size, entries[name]["bytes"]
        if size != expected:
            raise ValueError(f"{path} has {size} bytes instead of {expected}; {damaged}")
        if _sha256(path) != entries[name]["sha256"]:
            raise ValueError(f"{path} is not what was saved: its SHA-256 differs; {damaged}")


def _entries(folder: Path, damaged: str) -> dict[str, dict[str, Any]]:
    manifest, digest = folder / MANIFEST, folder / DIGEST
    if digest.exists() and digest.read_bytes().split() != [_sha256(manifest).encode(), MANIFEST.encode()]:
        raise ValueError(f"{manifest} or {DIGEST} is not what was saved: the SHA-256 differs; {damaged}")
    entries = cli.read_json(manifest, damaged)
    if not all(isinstance(entry, dict) and entry.keys() == {"bytes", "sha256"} for entry in entries.values()):
        raise ValueError(f"{manifest} is no list of sizes and SHA-256s; {damaged}")
    return entries


def _files(folder: Path) -> Iterator[tuple[str, Path]]:
    paths = (path for path in folder.rglob("*") if path.is_file())
    return ((path.relative_to(folder).as_posix(), path) for path in paths if path.name not in (MANIFEST, DIGEST))


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
