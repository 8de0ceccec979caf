"""The files that a command writes: where it may, whose place they may take, and that no result is lost."""

import json
import mmap
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from cassie_mjx.cli.origin import is_ours
from cassie_mjx.files import atomic
from cassie_mjx.files.atomic import write_text as write_text
from cassie_mjx.files.result import signed


class Kind(NamedTuple):
    """A kind of file that a command writes, and may replace."""

    name: str
    """With its article, as a sentence has it."""
    holds: Callable[[Path], bool]
    """Whether a file is of the kind."""


def marked(name: str, mark: bytes) -> Kind:
    """The kind of files that have `mark` somewhere in them."""

    def holds(path: Path) -> bool:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            return content.find(mark) >= 0

    return Kind(name, holds)


def _is_result(path: Path) -> bool:
    origin = json.loads(path.read_text())["provenance"]
    return {"command", "commit", "date"} <= origin.keys() and is_ours(origin["command"])


RESULT = Kind("a result of the same command", _is_result)
"""A JSON file with the provenance of the present command, whatever its keys were."""


def check_writable(out: str) -> Path:
    """The file `out`, or the one that a link `out` leads to; for the door, before hours of work.

    Whatever takes the place of a file must take that of the returned one. The format is what the ending of `out` says:
    that of a link's target may be another.

    Raises:
      ValueError: no file can be written there, or what is there is no regular file, such as a pipe or a device.
    """
    path = Path(os.path.realpath(out)) if Path(out).is_symlink() else Path(out)
    if path.is_dir() or not path.parent.is_dir():
        raise ValueError(f"{out} cannot be written; name a file in an existing folder that you may write to.")
    if os.path.lexists(path) and not path.is_file():
        raise ValueError(f"{out} is not a regular file, and would be replaced by one; name another file.")
    try:
        atomic.check_writable(path)
    except OSError as error:
        raise ValueError(
            f"{out} cannot be written ({error.strerror}); name a file in an existing folder that you may write to."
        ) from error
    return path


def check_output(out: str, kind: Kind, overwrite: bool) -> Path:
    """As `check_writable`, for a command's key `out`: a file that is there must be of the kind, or empty.

    Args:
      out: what the key says.
      kind: what is written there.
      overwrite: the command's key of that name, with which any file is replaced.

    Raises:
      ValueError: it cannot be written, or a file would be lost.
    """
    path = check_writable(out)
    if not overwrite and path.exists() and path.stat().st_size and not _holds(kind, path):
        raise ValueError(f"{out} exists and is not {kind.name}; name another file, or replace it with overwrite=true.")
    return path


def _holds(kind: Kind, path: Path) -> bool:
    try:
        return kind.holds(path)
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return False


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write `content` to `path` whole or not at all. Raises OSError that names `path`."""
    write_text(path, json.dumps(content, indent=1) + "\n")


def write_result(path: Path, content: dict[str, Any]) -> None:
    """Write what was measured to `path`, with its SHA-256; if that cannot be done, to the standard output.

    Raises:
      OSError: it stands on the standard output.
    """
    content = signed(content)
    try:
        write_json(path, content)
    except OSError as error:
        with suppress(OSError):
            print(json.dumps(content, indent=1), flush=True)
        raise OSError(f"{error} The result is on the standard output instead.") from error


def read_json(path: Path, advice: str) -> dict[str, Any]:
    """The JSON object in a file.

    Raises:
      ValueError: it cannot be read, or holds something else; the message ends in `advice`.
    """
    try:
        content = json.loads(path.read_bytes())
    except RecursionError as error:
        raise ValueError(f"{path} cannot be read (it is nested too deeply); {advice}") from error
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} cannot be read ({error}); {advice}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path} cannot be read (it holds no JSON object); {advice}")
    return content
