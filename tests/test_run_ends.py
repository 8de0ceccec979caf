"""How runs end before their time: by signals, and by a learner whose numbers are not finite any more."""

import io
import json
import math
import signal
import subprocess
import sys
import time
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console
from tiny import TINY, config, session

from cassie_mjx.agents.numpy_policy import NumpyPolicy
from cassie_mjx.training import checkpoint, runner
from cassie_mjx.training.interruption import ONE_S
from cassie_mjx.training.loggers import JsonLines, Terminal

# The main thread is in a call that Python cannot interrupt, as in a compilation of XLA's.
BUSY = """
import hashlib
from cassie_mjx.training.interruption import Interruption
with Interruption(lambda sentence: print(sentence, flush=True)):
    print("begun", flush=True)
    hashlib.pbkdf2_hmac("sha256", b"", b"", 10**9)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_second_signal_ends_the_process_at_once_in_one_line(number):
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", BUSY], **pipes) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "begun\n"
        process.send_signal(number)
        assert process.stdout.readline().startswith("Stopping after this iteration, with a checkpoint; a second signal")
        # As `timeout` sends it: twice for one.
        process.send_signal(number)
        time.sleep(ONE_S + 0.2)
        assert process.poll() is None
        began = time.monotonic()
        process.send_signal(number)
        _, complaint = process.communicate()
    assert time.monotonic() - began < 5
    assert process.returncode == 128 + number
    assert complaint == "Stopped at once; resume=true goes on from the last checkpoint.\n"


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and "events" not in path.name}


def test_a_learner_that_is_not_finite_stops_the_run_and_leaves_its_files(tmp_path):
    running = session(tmp_path, evaluate_every=1)
    iterate, before = running._iterate, {}

    def poison():
        if running.done == 1:
            before.update(contents(tmp_path))
            critic = running.run.learner.critic
            layer = next(iter(critic))
            poisoned = {**critic, layer: {**critic[layer], "bias": jnp.full_like(critic[layer]["bias"], jnp.nan)}}
            running.run = running.run._replace(learner=running.run.learner._replace(critic=poisoned))
        iterate()

    running._iterate = poison
    sentence = "stopped being finite in iteration 2, of which nothing is kept; the checkpoint of iteration 1 and"
    with pytest.raises(ValueError, match=sentence):
        running.train()
    assert contents(tmp_path) == before
    NumpyPolicy.load(tmp_path / "best.npz")
    last = checkpoint.latest(tmp_path / "checkpoints")
    assert last is not None
    assert all(np.isfinite(array).all() for array in checkpoint.restore(last).arrays.values())


def test_steps_that_are_far_too_large_are_said_to_be(tmp_path):
    huge = replace(TINY, max_grad_norm=None, iterations=5)
    # Further than a configuration can ask for: so that a few iterations are enough.
    object.__setattr__(huge, "critic_learning_rate", 1e20)
    with pytest.raises(ValueError, match=r"ppo.critic_learning_rate below 1e\+20, ppo.max_grad_norm=1.$"):
        runner.train_policy(config(tmp_path / "run", ppo=huge, evaluate_every=1))
    for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines():
        assert all(math.isfinite(value) for value in json.loads(line).values())


def test_what_is_said_keeps_its_brackets():
    console = Console(file=io.StringIO())
    Terminal(console, iterations=1, done=0).say("velocity [rad/s] in runs/[a]")
    assert console.file.getvalue() == "velocity [rad/s] in runs/[a]\n"


def test_metrics_are_json_whatever_is_measured(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_bytes(b'{"train/samples": "many"}\n' + b"[" * 100_000 + b'\n\xff\n{"train/samples": 3, "x": 1}\n')
    lines = JsonLines(path, samples=3)
    lines.write({"train/samples": 4, "x": math.nan, "y": math.inf})
    read = [json.loads(line, parse_constant=pytest.fail) for line in path.read_text().splitlines()]
    assert read == [{"train/samples": 3, "x": 1}, {"train/samples": 4, "x": None, "y": None}]


def test_where_time_went_survives_an_interruption(tmp_path):
    begun = session(tmp_path)
    begun._begin()
    begun._iterate()
    begun._save()
    spent = dict(begun.trainer.timer.seconds)
    assert spent.keys() == {"physics", "learner"}
    assert session(tmp_path, resume=True).trainer.timer.seconds == spent
