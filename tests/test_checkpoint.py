"""Checkpoints: whole or not at all, every byte checked, on any platform."""

import errno
import multiprocessing
import random
import subprocess
import sys
import time
from itertools import count
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cassie_mjx.motion.files import load_motion
from cassie_mjx.training import checkpoint

MOTION = load_motion("walk")


def state(number):
    """Arrays of all the kinds a run has, all following from one number."""
    rng = np.random.default_rng(number)
    return {
        "weights": (jnp.asarray(rng.normal(size=(80, 256)), jnp.float32), {"bias": jnp.zeros(3)}),
        "qpos": rng.normal(size=(128, 35)),
        "history": np.zeros((128, 0, 67)),
        "key": jax.random.key_data(jax.random.key(number)),
        "iteration": jnp.asarray(number),
        "ended": rng.normal(size=128) > 0,
    }


def assert_same(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x.dtype == y.dtype
        assert isinstance(x, jax.Array) == isinstance(y, jax.Array)
        assert np.array_equal(x, y)


def last(directory):
    return checkpoint.latest(directory) or pytest.fail("no checkpoint")


def test_a_run_comes_back_bit_for_bit(tmp_path):
    saved = checkpoint.save(tmp_path, 7, state(7), MOTION, {"counters": {"train_s": 0.1 + 0.2}})
    restored = checkpoint.restore(saved)
    assert_same(checkpoint.restore_into(state(0), restored.arrays), state(7))
    assert restored.record == {"counters": {"train_s": 0.1 + 0.2}}
    for ours, theirs in zip(jax.tree.leaves(restored.motion), jax.tree.leaves(MOTION), strict=True):
        assert np.array_equal(ours, theirs)


def test_another_precision_restores(tmp_path):
    saved = checkpoint.save(tmp_path, 1, {"x": np.arange(3.0) + 0.1, "y": jnp.ones(2)}, MOTION, {})
    arrays = checkpoint.restore(saved).arrays
    filled = checkpoint.restore_into({"x": jnp.zeros(3, jnp.float32), "y": np.zeros(2)}, arrays)
    assert filled["x"].dtype == jnp.float32
    assert filled["y"].dtype == np.float64
    assert np.array_equal(filled["x"], np.array([0.1, 1.1, 2.1], np.float32))


def test_what_one_process_saves_with_64_bits_another_restores_with_32(tmp_path):
    program = f"""
import jax
jax.config.update("jax_enable_x64", True)
import pathlib, jax.numpy as jnp
from cassie_mjx.motion.files import load_motion
from cassie_mjx.training import checkpoint
checkpoint.save(pathlib.Path({str(tmp_path)!r}), 1, {{"x": jnp.arange(3.0) + 0.1}}, load_motion("walk"), {{}})
"""
    subprocess.run([sys.executable, "-c", program], check=True)
    arrays = checkpoint.restore(last(tmp_path)).arrays
    assert np.array_equal(next(iter(arrays.values())), np.arange(3.0) + 0.1)
    filled = checkpoint.restore_into({"x": jnp.zeros(3)}, arrays)
    assert np.array_equal(filled["x"], np.array([0.1, 1.1, 2.1], np.float32))


def test_a_state_of_another_shape_is_refused(tmp_path):
    arrays = checkpoint.restore(checkpoint.save(tmp_path, 1, {"x": np.zeros(3)}, MOTION, {})).arrays
    with pytest.raises(ValueError, match=r"\['x'\] has shape \(3,\), not of shape \(4,\)"):
        checkpoint.restore_into({"x": np.zeros(4)}, arrays)
    with pytest.raises(ValueError, match=r"\['y'\] is missing"):
        checkpoint.restore_into({"y": np.zeros(3)}, arrays)


def test_two_checkpoints_are_kept_and_remains_removed(tmp_path):
    (tmp_path / "step_000009.partial" / "state").mkdir(parents=True)
    assert checkpoint.latest(tmp_path) is None
    for number in range(1, 4):
        checkpoint.save(tmp_path, number, state(number), MOTION, {})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["step_000002", "step_000003"]


@pytest.mark.parametrize("place", ["usage", "orbax", "fsync", "mkdir"])
def test_a_full_disk_leaves_the_last_checkpoint_intact(tmp_path, monkeypatch, place):
    checkpoint.save(tmp_path, 1, state(1), MOTION, {})

    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    def tensorstore_full(*_, **__):
        raise ValueError("RESOURCE_EXHAUSTED: Failed to write 9 bytes: No space left on device [os_error_code='28']")

    target, failure = {
        "usage": ("shutil.disk_usage", lambda _: SimpleNamespace(free=1_000_000)),
        "orbax": ("cassie_mjx.training.checkpoint.ocp.Checkpointer.save", tensorstore_full),
        "fsync": ("os.fsync", full),
        "mkdir": ("pathlib.Path.mkdir", full),
    }[place]
    with monkeypatch.context() as patched:
        patched.setattr(target, failure)
        with pytest.raises(OSError, match="No space left on device"):
            checkpoint.save(tmp_path, 2, state(2), MOTION, {})
    assert [path.name for path in tmp_path.iterdir()] == ["step_000001"]
    assert_same(checkpoint.restore_into(state(0), checkpoint.restore(last(tmp_path)).arrays), state(1))


def save_for_ever(directory, saved):
    """Go on from the last checkpoint; `saved` is set after the first save of this process."""
    whole = checkpoint.latest(directory)
    done = checkpoint.restore(whole).record["number"] if whole else 0
    for number in count(done + 1):
        checkpoint.save(directory, number, state(number), MOTION, {"number": number})
        saved.set()


def kill_while_saving(directory, times):
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["cassie_mjx.training.checkpoint"])
    rng, reached, interrupted = random.Random(0), 0, 0
    for _ in range(times):
        saved = context.Event()
        process = context.Process(target=save_for_ever, args=(directory, saved))
        process.start()
        assert saved.wait(60)
        time.sleep(rng.uniform(0, 0.3))
        process.kill()
        process.join()
        interrupted += any(path.name.endswith(".partial") for path in directory.iterdir())
        restored = checkpoint.restore(last(directory))
        number = restored.record["number"]
        assert_same(checkpoint.restore_into(state(0), restored.arrays), state(number))
        assert number > reached
        reached = number
    assert interrupted, "no kill fell into a save"


def test_kill_9_while_saving_leaves_a_whole_checkpoint(tmp_path):
    kill_while_saving(tmp_path, 5)


@pytest.mark.slow
def test_kill_9_at_twenty_moments(tmp_path):
    kill_while_saving(tmp_path, 20)
