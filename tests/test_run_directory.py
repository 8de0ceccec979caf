"""Run directories: what a run may go on with, what must be the same, and what is never begun anew or overwritten."""

import errno
import hashlib
import json
import os
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import tiny
from tiny import TINY, session

from cassie_mjx.agents.numpy_policy import NumpyPolicy
from cassie_mjx.motion.files import load_motion, save_motion
from cassie_mjx.training import checkpoint, run_directory
from cassie_mjx.training.config import resolve_config

SOFTWARE = {"commit": "a", "python": "3.11", "versions": {"jax": "0.9.2"}}
MOTION = load_motion("walk")
COUNTS = {"counters": {"train_s": 1.0}}


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def claim(folder, provenance=SOFTWARE, **changes):
    return run_directory.claim(folder, resolve_config(tiny.config(folder, **changes)), provenance)


def begun(folder, iteration=1, motion=MOTION, **changes):
    """A run with a checkpoint, as far as its directory tells."""
    claim(folder, **changes)
    checkpoint.save(folder / "checkpoints", iteration, {"x": np.ones(2)}, motion, COUNTS)
    return folder


def longer(iterations):
    return replace(TINY, iterations=iterations)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("finished")
    session(folder).train()
    return folder


# Without its checkpoints


@pytest.mark.parametrize("remains", ["empty", "missing"])
def test_a_run_whose_checkpoints_are_gone_is_refused_untouched(finished, tmp_path, remains):
    run = shutil.copytree(finished, tmp_path / "run")
    shutil.rmtree(run / "checkpoints")
    if remains == "empty":
        (run / "checkpoints").mkdir()
    before = contents(run)
    sentence = (
        r"run holds metrics.jsonl and best.npz and last.npz of a run, but no checkpoint to go on from; put its "
        r"checkpoints back, or choose another run_dir to begin anew \(init=.*run takes its best policy along\).$"
    )
    with pytest.raises(ValueError, match=sentence):
        session(run, resume=True)
    assert contents(run) == before


def test_checkpoints_that_cannot_be_listed_are_not_taken_for_none(finished, monkeypatch):
    def refuse(self):
        raise PermissionError(errno.EACCES, "Permission denied", str(self))

    monkeypatch.setattr(Path, "iterdir", refuse)
    before = contents(finished)
    with pytest.raises(OSError, match=r"Permission denied: .*checkpoints"):
        session(finished, resume=True)
    assert contents(finished) == before


def test_a_run_has_a_checkpoint_before_it_has_results(tmp_path, monkeypatch):
    def die(*_):
        raise RuntimeError

    monkeypatch.setattr("cassie_mjx.training.runner.walk_returns", die)
    with pytest.raises(RuntimeError):
        session(tmp_path).train()
    last = checkpoint.latest(tmp_path / "checkpoints")
    assert last is not None
    assert checkpoint.iteration_of(last) == 0
    monkeypatch.undo()
    again = session(tmp_path, resume=True)
    assert not again.begins
    again.train()
    assert again.done == TINY.iterations


def test_a_run_that_has_no_checkpoint_yet_begins_anew_and_says_so(tmp_path):
    claim(tmp_path)
    assert claim(tmp_path, resume=True).notes == [
        f"{tmp_path} holds a run without a checkpoint yet, which begins anew."
    ]


@pytest.mark.parametrize("resume", [False, True])
def test_results_without_a_configuration_are_refused_untouched(finished, tmp_path, resume):
    run = shutil.copytree(finished, tmp_path / "run")
    (run / "config.json").unlink()
    before = contents(run)
    with pytest.raises(ValueError, match="choose another run_dir.$"):
        session(run, resume=resume)
    assert contents(run) == before


@pytest.mark.parametrize("damage", ["missing", "damaged"])
def test_a_best_policy_that_is_lost_is_replaced_by_the_last_and_said_to_be(finished, tmp_path, damage):
    run = shutil.copytree(finished, tmp_path / "run")
    best = run / "best.npz"
    if damage == "missing":
        best.unlink()
    else:
        best.write_bytes(best.read_bytes()[:1000])
    again = session(run, resume=True)
    again.train()
    said = again.terminal._console.file.getvalue()
    assert "best.npz was missing or damaged: the best policy, with a return of" in said
    assert NumpyPolicy.load(best).provenance["samples"] == TINY.iterations * TINY.num_samples
    assert f"Done: a return of {NumpyPolicy.load(best).provenance['return_plain']:.1f} of 300" in said
    silent = session(run, resume=True)
    silent.train()
    assert "lost" not in silent.terminal._console.file.getvalue()


# Beginning


@pytest.mark.parametrize("resume", [False, True])
def test_a_start_that_a_full_disk_cut_short_can_be_made_again(tmp_path, monkeypatch, resume):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr(Path, "replace", full)
        with pytest.raises(
            OSError, match=r"config\.json could not be written \(No space left on device\); nothing was"
        ):
            claim(tmp_path / "run", resume=resume)
    (tmp_path / "run" / "config.json.1a2b3c4d.partial").write_text("{")
    (tmp_path / "run" / "run.lock").write_text("")
    assert claim(tmp_path / "run", resume=resume).restored is None
    assert (tmp_path / "run" / "config.json").exists()


@pytest.mark.parametrize("content", ["[]", "[" * 100_000, '{"config": 1}', '{"config": {}, "provenance": 1}', "\xff"])
def test_a_damaged_configuration_is_refused_in_one_sentence(tmp_path, content):
    (tmp_path / "config.json").write_bytes(content.encode("latin1"))
    with pytest.raises(ValueError, match=r"config.json cannot be read \(.*\); choose another run_dir.$"):
        claim(tmp_path, resume=True)


# Going on


def test_what_a_run_was_begun_with_is_given_as_the_command_line_takes_it(tmp_path):
    folder = begun(tmp_path, physics="mjx", ppo=replace(TINY, max_grad_norm=None))
    sentence = (
        r"holds another run, with physics=mjx, ppo.hidden_sizes=\[16,16\], ppo.max_grad_norm=null; choose another "
        r"run_dir, or go on with that run by adding physics=mjx 'ppo.hidden_sizes=\[16,16\]' ppo.max_grad_norm=null "
        "resume=true$"
    )
    with pytest.raises(ValueError, match=sentence):
        claim(folder, ppo=replace(TINY, hidden_sizes=(8,)), resume=True)


def test_a_run_can_be_made_longer_and_measured_otherwise(tmp_path):
    folder = begun(tmp_path)
    restored, _, _, notes = claim(folder, ppo=longer(5), evaluate_every=1, resume=True)
    assert restored is not None
    assert notes == [
        "From iteration 1 on: ppo.iterations=5 instead of 2, evaluate_every=1 instead of 2; schedules count to the "
        "new total."
    ]
    held = json.loads((folder / "config.json").read_text())
    assert (held["config"]["ppo.iterations"], held["config"]["evaluate_every"]) == (5, 1)
    old, new = {"ppo.iterations": 2, "evaluate_every": 2}, {"ppo.iterations": 5, "evaluate_every": 1}
    assert held["changes"] == [{"iteration": 1, "from": old, "to": new}]
    assert held["provenance"] == SOFTWARE
    assert claim(folder, ppo=longer(5), evaluate_every=1, resume=True).notes == []
    claim(folder, ppo=longer(7), evaluate_every=1, resume=True)
    assert len(json.loads((folder / "config.json").read_text())["changes"]) == 2


def test_a_run_cannot_be_made_shorter(tmp_path):
    folder = begun(tmp_path, ppo=longer(9))
    before = contents(folder)
    with pytest.raises(ValueError, match="with ppo.iterations=9; .* by adding ppo.iterations=9 resume=true$"):
        claim(folder, ppo=longer(8), resume=True)
    assert contents(folder) == before


def test_a_finished_run_that_is_made_longer_goes_on_from_its_end(finished, tmp_path):
    run = shutil.copytree(finished, tmp_path / "run")
    again = session(run, ppo=longer(4), resume=True)
    assert again.done == 2
    again.train()
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert [line["train/iteration"] for line in lines] == [2, 4]
    # The critic's rate falls linearly: 1 - 3/4 of it in the fourth iteration of four.
    assert lines[-1]["learner/critic_learning_rate"] == pytest.approx(TINY.critic_learning_rate / 4)


@pytest.fixture
def recorded(tmp_path):
    """A motion's file, and a run that imitates it."""
    path = tmp_path / "mine.npz"
    save_motion(path, MOTION, {})
    return path, begun(tmp_path / "run", reference=str(path))


def test_a_run_whose_reference_has_moved_goes_on(recorded, tmp_path):
    path, run = recorded
    moved = tmp_path / "elsewhere" / "other.npz"
    moved.parent.mkdir()
    path.rename(moved)
    assert claim(run, reference=str(moved), resume=True).notes == []
    # The old command still works, with what the checkpoint holds.
    _, motion, _, (note,) = claim(run, reference=str(path), resume=True)
    assert note == f"reference={path} is not here: the run goes on with the motion in its checkpoint."
    assert np.array_equal(motion.qpos, MOTION.qpos)
    assert claim(run, reference="walk", resume=True).notes == []


def test_a_run_goes_on_from_another_working_directory(tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    save_motion(Path("mine.npz"), MOTION, {})
    run = begun(tmp_path / "run", reference="mine.npz")
    monkeypatch.chdir(tmp_path)
    assert "is not here" in claim(run, reference="mine.npz", resume=True).notes[0]


def test_another_motion_of_the_same_name_is_refused(recorded):
    path, run = recorded
    save_motion(path, MOTION._replace(qvel=MOTION.qvel + 1e-6), {})
    before = contents(run)
    with pytest.raises(ValueError, match="mine.npz is another motion than the one in the checkpoints of .*run; give"):
        claim(run, reference=str(path), resume=True)
    assert contents(run) == before


def test_a_misspelt_reference_is_refused(recorded):
    with pytest.raises(ValueError, match="'mime.npz' is neither walk nor a file"):
        claim(recorded[1], reference="mime.npz", resume=True)


def test_a_run_goes_on_if_the_policy_it_began_with_has_moved(finished, tmp_path):
    given, moved = tmp_path / "given.npz", tmp_path / "moved.npz"
    shutil.copy(finished / "best.npz", given)
    run = begun(tmp_path / "run", init=str(given))
    digest = hashlib.sha256(given.read_bytes()).hexdigest()
    assert json.loads((run / "config.json").read_text())["init_sha256"] == digest
    given.rename(moved)
    for init in (given, moved):
        assert claim(run, init=str(init), resume=True).notes == []
    with pytest.raises(ValueError, match="with init=.*given.npz; choose another run_dir"):
        claim(run, init="1x", resume=True)
    with pytest.raises(ValueError, match="with init=.*given.npz; choose another run_dir"):
        claim(run, resume=True)


def test_other_software_than_that_of_the_beginning_is_named_at_every_resume(tmp_path):
    folder = begun(tmp_path)
    other = SOFTWARE | {"commit": "b", "versions": {"jax": "0.9.3"}}
    for iteration in (2, 3):
        notes = claim(folder, other, resume=True).notes
        assert notes == ["The run was begun with other software: commit a then, b now; jax 0.9.2 then, 0.9.3 now."]
        record = COUNTS | {"provenance": other}
        checkpoint.save(folder / "checkpoints", iteration, {"x": np.ones(2)}, MOTION, record)


def test_a_run_of_an_earlier_version_goes_on(tmp_path):
    """Its configuration has neither the digest of a policy nor changes, its record nothing but counters."""
    config = run_directory.comparable(asdict(resolve_config(tiny.config(tmp_path))))
    (tmp_path / "config.json").write_text(json.dumps({"config": config, "provenance": SOFTWARE}))
    checkpoint.save(tmp_path / "checkpoints", 1, {"x": np.ones(2)}, MOTION, COUNTS)
    assert claim(tmp_path, resume=True).notes == []
