"""Trainings that are stopped at random moments, and go on to the same end."""

import json
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from cassie_mjx.agents.numpy_policy import NumpyPolicy
from tests import tiny
from tests.fuzz.outcome import DIFFERENT, LOST, SAME, TRACEBACK, Outcome

ROOT = Path(__file__).parents[2]
STOPS = (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
ARGUMENTS = [word for word in tiny.ARGUMENTS if not word.startswith("ppo.iterations")] + ["ppo.iterations=12"]
# By a signal's default before Python has handlers of its own.
STOPPED = {0, *(128 + number for number in STOPS), *(-number for number in STOPS)}


def _start(run: Path) -> subprocess.Popen[str]:
    words = ["-m", "cassie_mjx.train", f"run_dir={run}", "resume=true", *ARGUMENTS]
    command = [sys.executable, *words]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def _end(run: Path) -> object:
    """What must not depend on when a run was stopped: the last policy, and the numbers of each iteration."""
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    policy = NumpyPolicy.load(run / "last.npz")
    weights = [array.tobytes() for layer in policy.weights for array in layer]
    return weights, [{key: value for key, value in line.items() if not key.startswith("time/")} for line in lines]


def attempts(folder: Path, count: int, seed: int) -> Iterator[Outcome]:
    """`count` runs, each stopped until it is done; each must end as the run that nobody stopped."""
    began = time.monotonic()
    process = _start(folder / "whole")
    _, errors = process.communicate()
    whole_s = time.monotonic() - began
    assert process.returncode == 0, errors
    expected = _end(folder / "whole")
    rng = random.Random(f"kills {seed}")
    for k in range(count):
        yield _stopped_and_resumed(folder / f"run{k}", rng, whole_s, expected)


def _stopped_and_resumed(run: Path, rng: random.Random, whole_s: float, expected: object) -> Outcome:
    said = []
    for attempt in range(10):
        process, stop = _start(run), rng.choice(STOPS)
        try:
            _, errors = process.communicate(timeout=None if attempt == 9 else rng.uniform(0.2, 1.1) * whole_s)
        except subprocess.TimeoutExpired:
            process.send_signal(stop)
            _, errors = process.communicate()
            said.append(signal.Signals(stop).name)
        if "Traceback" in errors or process.returncode not in STOPPED:
            return Outcome(TRACEBACK, f"{run.name}: {said}", f"status {process.returncode}: {errors}")
        if process.returncode == 0:
            break
    if not (run / "last.npz").is_file():
        return Outcome(LOST, f"{run.name}: {said}", "no last.npz")
    return Outcome(SAME if _end(run) == expected else DIFFERENT, f"{run.name}: {said}")
