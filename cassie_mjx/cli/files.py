"""Files written whole or not at all."""

import json
import os
from pathlib import Path
from typing import Any


def check_writable(out: str) -> Path:
    """The file `out`, or the one that a link `out` leads to; for the door, before hours of work.

    Whatever takes the place of a file must take that of the returned one. The format is what the ending of `out` says:
    that of a link's target may be another.

    Raises:
      ValueError: no file can be written there, or what is there is no regular file, such as a pipe or a device.
    """
    path = Path(os.path.realpath(out)) if Path(out).is_symlink() else Path(out)
    if path.is_dir() or not path.parent.is_dir() or not os.access(path.parent, os.W_OK):
        raise ValueError(f"{out} cannot be written; name a file in an existing folder that you may write to.")
    if os.path.lexists(path) and not path.is_file():
        raise ValueError(f"{out} is not a regular file, and would be replaced by one; name another file.")
    return path


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write `content` to `path` whole or not at all."""
    write_text(path, json.dumps(content, indent=1) + "\n")


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


def write_text(path: Path, text: str) -> None:
    """Write `text` to `path` whole or not at all."""
    partial = path.with_name(path.name + ".partial")
    partial.write_text(text)
    partial.replace(path)
