"""Files that are flipped, cut, swapped, overwritten or deleted, and the readers that must notice."""

import random
import shutil
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from cassie_mjx import cli
from cassie_mjx.agents.numpy_policy import NumpyPolicy
from cassie_mjx.agents.shipped import shipped_policies
from cassie_mjx.motion.files import read_motion, shipped_path
from cassie_mjx.reporting.results import read
from cassie_mjx.training.checkpoint import restore_last
from tests import tiny
from tests.fuzz.outcome import Outcome, tried


class Sample(NamedTuple):
    """A file or folder that the project writes, and how it is read."""

    name: str
    path: Path
    read: Callable[[Path], Any]


def samples(folder: Path) -> list[Sample]:
    """One of each kind of file, written to `folder`."""
    policy, motion, result, run = (folder / name for name in ("policy.npz", "motion.npz", "result.json", "run"))
    shutil.copy(shipped_policies()["1x-robust"], policy)
    shutil.copy(shipped_path("walk"), motion)
    tiny.session(run).train()
    figures = [{"agent": "1x", "quantity": "speed_mps", "value": 0.726, "unit": "m/s", "n": 10}]
    cli.write_result(result, {"rows": figures, "provenance": cli.provenance(seed=0)})
    return [
        Sample("policy", policy, NumpyPolicy.load),
        Sample("motion", motion, read_motion),
        Sample("result", result, _figures),
        Sample("checkpoints", run / "checkpoints", restore_last),
    ]


def _figures(path: Path) -> Any:
    result = read(path.parent, path.name)
    return result.content["rows"], result.provenance


def damaged(content: bytes, rng: random.Random) -> tuple[str, bytes]:
    """The content with one damage, and what was done."""
    size = len(content)
    kind = rng.choice(("flip", "flip", "flip", "cut", "drop", "swap", "overwrite", "insert", "empty"))
    start = rng.randrange(size)
    stop = min(size, start + rng.choice((1, 16, 512)))
    if kind == "flip":
        bit = rng.randrange(8)
        return f"bit {bit} of byte {start}", content[:start] + bytes([content[start] ^ 1 << bit]) + content[start + 1 :]
    if kind == "cut":
        return f"cut at {start}", content[:start]
    if kind == "drop":
        return f"bytes {start} to {stop} dropped", content[:start] + content[stop:]
    if kind == "swap":
        other = rng.randrange(size)
        low, high = sorted((start, other))
        changed = bytearray(content)
        changed[low], changed[high] = content[high], content[low]
        return f"bytes {low} and {high} swapped", bytes(changed)
    if kind == "overwrite":
        return f"bytes {start} to {stop} overwritten", content[:start] + rng.randbytes(stop - start) + content[stop:]
    if kind == "insert":
        return f"a byte inserted at {start}", content[:start] + rng.randbytes(1) + content[start:]
    return "emptied", b""


def attempts(folder: Path, count: int, seed: int) -> Iterator[Outcome]:
    """`count` damages of each sample; each reader must refuse in a sentence, or give what was written.

    Of checkpoints, several whole ones are kept: the reader may also go back to an earlier one, if it says so.
    """
    for sample in samples(folder):
        whole = sample.read(sample.path)
        rng = random.Random(f"{sample.name} {seed}")
        for k in range(count):
            if sample.path.is_dir():
                yield _in_folder(sample, whole, rng, f"{sample.name} {k}")
            else:
                what, content = damaged(sample.path.read_bytes(), rng)
                path = folder / "damaged.npz"
                path.write_bytes(content)
                yield tried(f"{sample.name}: {what}", partial(sample.read, path), partial(same, whole))


def _in_folder(sample: Sample, whole: Any, rng: random.Random, name: str) -> Outcome:
    """One damage to one file in a folder, undone afterwards."""
    path = rng.choice([each for each in sorted(sample.path.rglob("*")) if each.is_file()])
    content = path.read_bytes()
    if rng.random() < 0.1 or not content:
        what = "deleted"
        path.unlink()
    else:
        what, changed = damaged(content, rng)
        path.write_bytes(changed)

    def restored(got: Any) -> bool:
        (checkpoint, notes), (expected, _) = got, whole
        return bool(notes) or same(checkpoint, expected)

    outcome = tried(f"{name}, {path.relative_to(sample.path)}: {what}", lambda: sample.read(sample.path), restored)
    path.write_bytes(content)
    return outcome


def same(a: Any, b: Any) -> bool:
    """Whether two values hold the same numbers and texts."""
    if hasattr(a, "__dataclass_fields__"):
        return type(a) is type(b) and same(vars(a), vars(b))
    leaves_a, leaves_b = (jax.tree_util.tree_leaves_with_path(x) for x in (a, b))
    pairs = list(zip(leaves_a, leaves_b, strict=False))
    return len(leaves_a) == len(leaves_b) and all(p == q and np.array_equal(x, y) for (p, x), (q, y) in pairs)
