"""Wrong values for every key of every command and experiment, and commands that are run with some of them."""

import os
import random
import runpy
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

from cassie_mjx import cli
from cassie_mjx.cli.keys import keys_of
from tests import tiny
from tests.fuzz.outcome import HANG, REFUSED, SAME, TRACEBACK, Outcome, one_sentence, tried

ROOT = Path(__file__).parents[2]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}
FILES = [path for folder in ("cassie_mjx", "experiments") for path in sorted((ROOT / folder).glob("*.py"))]
COMMANDS = [path for path in FILES if "__main__" in path.read_text()]

VALUES = [
    *("", "null", "None", "nan", "inf", "-inf", "-1", "0", "-0.0", ".5", "5.", "1e", "0x10", "1_000", "true"),
    *("1e-300", "1e300", "1e9", "1000000000", "99999999999999999999", "1,2", "1,2,3", "[]", "[1", "]", "{a: 1}"),
    *("a", "1x", "-1x", "4.5x", "any", "ä", "a b", "'", '"', "a=b", "=", "../x", "/proc/x", "~", "%", "$HOME"),
    *("[/red]", "\\", "!!python/object:os"),
]
SHAPES = ["--seed=1", "seed", "seed:1", "=1", ".=1", "walk.=1", "walk=5", "ppo=null", "a.b.c=1", "=", "", "-", "--"]

SMALL = {
    "train": ["run_dir={folder}/run", *tiny.ARGUMENTS],
    "evaluate": ["policy=1x", "suite=walk", "out={folder}/out.json"],
    "render": ["policy=1x", "out={folder}/out.gif", "seconds=0.1", "width=64", "height=48"],
    "export": ["policy=1x", "out={folder}/out.npz"],
    "report": ["results={folder}", "out={folder}/out.html"],
}
"""Arguments with which a command is over in seconds."""


def configurations() -> Iterator[tuple[str, tuple[Any, ...], list[str]]]:
    """Each command's name, what `cli.parse` takes to read its arguments, and its keys."""
    for path in COMMANDS:
        found: list[Any] = []

        def run(main: Any, config: Any, *more: Any, found: list[Any] = found) -> None:
            # The docstrings of the keys are at hand while the file runs.
            found.extend(((config, *more[:2]), list(keys_of(config, more[0] if more else {}))))

        with mock.patch.object(cli, "run", run), mock.patch("sys.argv", [str(path)]):
            runpy.run_path(str(path), run_name="__main__")
        yield f"{path.parent.name}.{path.stem}", *found


def attempts(count: int, seed: int) -> Iterator[Outcome]:
    """`count` wrong values to each command; none is run, and each must be taken or refused in a sentence."""
    rng = random.Random(f"values {seed}")
    for name, (config, *more), keys in configurations():
        for _ in range(count):
            chosen = [f"{rng.choice(keys)}={rng.choice(VALUES)}" for _ in range(rng.choice((1, 1, 2)))]
            arguments = chosen if rng.random() < 0.9 else [rng.choice(SHAPES)]

            def parse(config: Any = config, arguments: list[str] = arguments, more: list[Any] = more) -> None:
                cli.parse(config, arguments, *more)

            yield tried(f"{name} {shlex.join(arguments)}", parse, lambda _: True)


def run_attempts(folder: Path, count: int, seed: int) -> Iterator[Outcome]:
    """`count` odd values to each command that are not refused at once, run to the end within two minutes.

    The end is status 0, or 2 and one sentence.
    """
    rng = random.Random(f"runs {seed}")
    for name, (config, *more), keys in configurations():
        package, command = name.split(".")
        if package != "cassie_mjx" or command not in SMALL:
            continue
        # One of several processes would wait for the others.
        pairs = [f"{key}={value}" for key in keys if key != "distributed" for value in VALUES]
        rng.shuffle(pairs)
        for k in range(count):
            place = folder / f"{command}-{k}"
            place.mkdir()
            base = [word.format(folder=place) for word in SMALL[command]]
            odd = next(pair for pair in iter(pairs.pop, None) if _is_taken(config, [*base, pair], more))
            yield _run(["-m", name, *base, odd], place)


def _is_taken(config: Any, arguments: list[str], more: list[Any]) -> bool:
    try:
        cli.parse(config, arguments, *more)
    except ValueError:
        return False
    return True


def _run(words: list[str], place: Path) -> Outcome:
    try:
        command = [sys.executable, *words]
        done = subprocess.run(
            command, cwd=place, env=ENVIRONMENT, capture_output=True, text=True, check=False, timeout=120
        )
    except subprocess.TimeoutExpired:
        return Outcome(HANG, shlex.join(words), "longer than 120 s")
    *_, last = done.stderr.strip().splitlines() or [""]
    if done.returncode == 0:
        return Outcome(SAME, shlex.join(words))
    if done.returncode == 2 and "Traceback" not in done.stderr and one_sentence(last):
        return Outcome(REFUSED, shlex.join(words), last)
    return Outcome(TRACEBACK, shlex.join(words), done.stderr)
