"""Result files read back."""

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cassie_mjx.files.result import check

PROVENANCE = ("command", "commit", "date", "hardware")


@dataclass(frozen=True)
class Result:
    """One result file."""

    name: str
    """Its path below the folder of results."""
    content: dict[str, Any]

    @property
    def provenance(self) -> dict[str, Any]:
        """Command, commit, date, hardware, and what else was recorded."""
        return self.content["provenance"]

    @property
    def seed(self) -> str:
        """Seed of the training run whose policy was measured; "" if the name of the file has none."""
        found = re.search(r"-seed(\d+)\.json$", self.name)
        return found[1] if found else ""

    def value(self, quantity: str, agent: str | None = None) -> float | None:
        """The value of a quantity, of one agent if several are in the file; None if it was not measured."""
        return next(iter(self.values(quantity, agent)), None)

    def values(self, quantity: str, agent: str | None = None) -> list[float]:
        """The values of a quantity, of one agent if several are in the file; one a seed of its training."""
        rows = (r for r in self.content["rows"] if r.get("quantity") == quantity and agent in (None, r["agent"]))
        return [row["value"] for row in rows]


@contextmanager
def blaming(path: Path) -> Iterator[None]:
    """Turn whatever is missing or wrong in the content of a result file into one sentence that names the file."""
    try:
        yield
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        why = f"no {error}" if isinstance(error, KeyError) else str(error)
        raise ValueError(f"{path} is not a result as expected: {why}; make it again or move it away.") from error


def _present_names(content: Any) -> Any:
    """A result with the keys of today: what is measured was once called "subject"."""
    if isinstance(content, dict):
        return {"agent" if key == "subject" else key: _present_names(value) for key, value in content.items()}
    return [_present_names(value) for value in content] if isinstance(content, list) else content


def read(folder: Path, name: str) -> Result:
    """The result file `name` in `folder`.

    Raises:
      ValueError: it is no JSON or altered, has no rows or no provenance, or the value of a quantity is no number.
    """
    with blaming(folder / name):
        written = json.loads((folder / name).read_text())
        check(written)
        content = _present_names(written)
        for key in PROVENANCE:
            content["provenance"][key].strip()
        for row in content["rows"]:
            if row.keys() >= {"agent", "quantity"}:
                row["value"] = float(row["value"])
    return Result(name, content)


def find(folder: Path, pattern: str) -> list[Result]:
    """The results whose path below `folder` matches a glob pattern, in the order of their names."""
    return [read(folder, path.relative_to(folder).as_posix()) for path in sorted(folder.glob(pattern))]
