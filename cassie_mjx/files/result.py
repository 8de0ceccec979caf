"""Results as JSON with their SHA-256, so that a figure that was altered is not taken for one that was measured."""

import hashlib
import json
from collections.abc import Mapping
from typing import Any

KEY = "sha256"
"""Where a result has the digest of all the rest."""


def signed(content: Mapping[str, Any]) -> dict[str, Any]:
    """A result with its digest."""
    return {**content, KEY: _digest(content)}


def check(content: Mapping[str, Any]) -> None:
    """Raise ValueError if a result has a digest that is not that of its content; results of before have none."""
    if not isinstance(content, Mapping):
        raise ValueError("it holds no JSON object")
    rest = {name: value for name, value in content.items() if name != KEY}
    if KEY in content and content[KEY] != _digest(rest):
        raise ValueError("its SHA-256 is another, so it is not as it was measured")


def _digest(content: Mapping[str, Any]) -> str:
    # As it is read back: tuples are lists, and keys are texts.
    read = json.loads(json.dumps(content))
    return hashlib.sha256(json.dumps(read, sort_keys=True).encode()).hexdigest()
