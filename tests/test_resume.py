"""What a run that goes on still knows, and what it says of itself."""

import json
import shutil

import numpy as np
import pytest
from tiny import TINY, halt_after_one, session

from cassie_mjx.envs.config import WalkConfig
from cassie_mjx.motion.files import load_motion
from cassie_mjx.training import checkpoint
from cassie_mjx.training.run_directory import changes

MOTION = load_motion("walk")


def lines(folder):
    """What a run measured, but for times."""
    read = (json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines())
    return [{key: value for key, value in line.items() if not key.startswith("time/")} for line in read]


def test_counts_since_the_last_evaluation_survive_an_interruption(tmp_path):
    """Episodes that end at once are counted in iterations 1 and 2, and the run stops between the two."""
    task = {"ppo": TINY, "evaluate_every": 2, "walk": WalkConfig(min_reward=0.9, episode_steps=3)}
    session(tmp_path / "whole", **task).train()
    halt_after_one(tmp_path / "halted", **task)
    session(tmp_path / "halted", resume=True, **task).train()
    whole, halted = lines(tmp_path / "whole"), lines(tmp_path / "halted")
    assert whole[-1]["train/low_reward"] > 0
    assert halted == whole


def test_the_millionth_checkpoint_is_later_than_the_one_before(tmp_path):
    for number in (999_998, 999_999, 1_000_000):
        checkpoint.save(tmp_path, number, {"x": np.ones(2)}, MOTION, {})
    last = checkpoint.latest(tmp_path)
    assert last is not None
    assert checkpoint.iteration_of(last) == 1_000_000


def test_a_damaged_checkpoint_gives_way_to_the_one_before(tmp_path):
    session(tmp_path, evaluate_every=1).train()
    last = checkpoint.latest(tmp_path / "checkpoints")
    assert last is not None
    (last / "record.json").write_text("{")
    again = session(tmp_path, evaluate_every=1, resume=True)
    assert again.done == TINY.iterations - 1
    (note,) = again.notes
    assert "record.json" in note
    assert note.endswith("The run goes on from the checkpoint before it.")
    again.train()
    assert again.done == TINY.iterations
    assert len(lines(tmp_path)) == TINY.iterations
    for whole in (tmp_path / "checkpoints").iterdir():
        shutil.rmtree(whole / "state")
    with pytest.raises(ValueError, match="holds no checkpoint that is whole; choose another run_dir"):
        session(tmp_path, evaluate_every=1, resume=True)


def test_a_save_leaves_no_damaged_checkpoint_of_a_later_iteration(tmp_path):
    """A run that went back from 4 to 2 and is stopped at 3 keeps two that are whole."""
    for number in (2, 4):
        checkpoint.save(tmp_path, number, {"x": np.ones(2)}, MOTION, {})
    (tmp_path / "step_000004" / "record.json").write_text("{")
    checkpoint.save(tmp_path, 3, {"x": np.ones(2)}, MOTION, {})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["step_000002", "step_000003"]


def test_other_software_is_named():
    now = {"commit": "b", "python": "3.11", "versions": {"jax": "0.9.2", "numpy": "2.4"}}
    assert changes(now, now) == []
    then = {"commit": "a", "python": "3.11", "versions": {"jax": "0.9.1", "numpy": "2.4"}}
    assert changes(then, now) == [
        "The run was begun with other software: commit a then, b now; jax 0.9.1 then, 0.9.2 now."
    ]
