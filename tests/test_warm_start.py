"""Training from another policy, and training under disturbances: what they start from and how they resume."""

import io
import json
from dataclasses import replace

import acting
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console
from tiny import TINY, session

from cassie_mjx.agents.numpy_policy import NumpyPolicy
from cassie_mjx.control.observation import OBSERVATIONS
from cassie_mjx.envs.config import WalkConfig
from cassie_mjx.envs.scenario import ScenarioConfig
from cassie_mjx.ppo import normalizer
from cassie_mjx.training import checkpoint
from cassie_mjx.training.config import TrainConfig
from cassie_mjx.training.runner import Runner
from cassie_mjx.training.sentences import clipping

ALL = WalkConfig(scenario=ScenarioConfig(push_n=100, push_pause_s=0.1, terrain_m=0.1, delay_s=0.004))


def last_state(folder):
    last = checkpoint.latest(folder / "checkpoints")
    return checkpoint.restore(last).arrays if last else pytest.fail("no checkpoint")


def assert_same_state(one, other):
    ours, theirs = last_state(one), last_state(other)
    assert ours.keys() == theirs.keys()
    assert all(np.array_equal(ours[name], theirs[name]) for name in ours)


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    folder = tmp_path_factory.mktemp("first")
    session(folder, walk=WalkConfig(symmetric=False)).train()
    return folder


@pytest.mark.parametrize("named", ["directory", "file"])
def test_a_run_starts_as_the_policy_it_is_given(first, tmp_path, named):
    path = first / "best.npz"
    begun = session(tmp_path, init=str(first if named == "directory" else path), seed=5)
    saved, policy = NumpyPolicy.load(path), begun.run.learner.policy
    seen = saved.mean + saved.std * np.random.default_rng(0).normal(size=(50, 80)).astype(np.float32)
    np.testing.assert_allclose(acting.mode(policy, jnp.asarray(seen)), saved(seen), atol=1e-5)
    assert float(policy.normalizer.samples) == saved.samples


def test_it_takes_the_input_statistics_of_its_own_task_and_stays_the_same_policy(first, tmp_path):
    """A stretched reference moves inputs by several standard deviations; the first layer makes up for it."""
    begun = session(tmp_path, init=str(first), seed=5, speed="2x")
    before = begun.run.learner.policy
    run = begun.trainer.gather_statistics(begun.run)
    after, seen = run.learner.policy, jnp.asarray(run.env.observation)
    assert np.abs((after.normalizer.mean - before.normalizer.mean) / normalizer.std(before.normalizer)).max() > 3
    inside = before.normalizer.mean + normalizer.std(before.normalizer) * np.random.default_rng(0).normal(size=(50, 80))
    inside = jnp.asarray(inside, jnp.float32)
    within = np.abs(np.asarray(normalizer.normalize(after.normalizer, inside))).max(axis=1) < normalizer.CLIP
    ours, theirs = (np.asarray(acting.mode(policy, inside))[within] for policy in (after, before))
    np.testing.assert_allclose(ours, theirs, atol=1e-4)
    assert np.abs(normalizer.normalize(after.normalizer, seen)).max() < normalizer.CLIP


def test_a_curriculum_has_the_input_statistics_of_its_end(tmp_path):
    """Training begins with 0.7 m/s alone; commands go from -0.7 to 2.8 m/s."""
    walk = WalkConfig(scenario=ScenarioConfig(push_n=100, push_curriculum=True))
    ppo = replace(TINY, num_robots=64, normalizer_samples=4096)
    begun = session(tmp_path, command="joystick", walk=walk, ppo=ppo)
    run = begun.trainer.gather_statistics(begun.run)
    velocity, statistics = 46, run.learner.policy.normalizer  # of the reference, along x
    commands = np.array([begun.run.env.observation[:, velocity], run.env.observation[:, velocity]])
    assert commands.std() < 0.1, "robots begin at the motion's own speed"
    fastest = (2.8 - statistics.mean[velocity]) / normalizer.std(statistics)[velocity]
    assert 1 < fastest < 4


def test_inputs_that_are_clipped_are_told_to_the_user(first, tmp_path):
    """Statistics of 1x, moved by 20 deviations in one input of 80: it is clipped in every sample."""
    begun = session(tmp_path, init=str(first), seed=5)
    run = begun.trainer.gather_statistics(begun.run)
    _, calm = begun.trainer.iterate(run)
    assert calm.clipped.shape == (80,)
    assert calm.clipped.mean() < 0.01
    statistics = run.learner.policy.normalizer
    moved = statistics._replace(mean=statistics.mean.at[5].add(20 * normalizer.std(statistics)[5]))
    policy = run.learner.policy._replace(normalizer=moved)
    begun.run, begun.begins = run._replace(learner=run.learner._replace(policy=policy)), False
    begun.config = replace(begun.config, evaluate_every=1)
    begun.train()
    said = " ".join(begun.terminal._console.file.getvalue().split())
    (line,) = [line for line in begun.law.observation.describe() if _holds(line, 5)]
    assert "of the policy's 80 inputs are clipped in more than 1% of the samples; most often input 5, in " in said
    assert f"({line})" in said
    # After the first evaluation, and after the last.
    assert said.count("are clipped") == 2
    shares = [json.loads(line)["train/clipped_share"] for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert min(shares) > 0.95


def _holds(line, index):
    start, stop = map(int, line.split()[0].split(":"))
    return start <= index < stop


def test_a_single_input_that_is_clipped_is_enough_and_a_share_of_a_hundredth_is_not():
    shares, terms = np.zeros(80), OBSERVATIONS["full"].describe()
    shares[79] = 0.01
    assert clipping(shares, terms) == ""
    shares[79] = 0.011
    assert clipping(shares, terms).startswith("1 of the policy's 80 inputs are clipped in more than 1% of the samples")


def test_a_policy_of_other_gains_is_said_to_be_one(first, tmp_path):
    begun = session(tmp_path, init=str(first), walk=WalkConfig(kd_scale=0.5))
    assert begun.notes == [f"init={first} was trained with 1 times the published D gains, this run has 0.5 times."]


def test_it_resumes_without_the_policy_it_started_from(first, tmp_path):
    given = tmp_path / "given.npz"
    given.write_bytes((first / "best.npz").read_bytes())
    session(tmp_path / "unbroken", init=str(given)).train()
    stop_after(1, session(tmp_path / "stopped", init=str(given)))
    given.unlink()
    session(tmp_path / "stopped", init=str(given), resume=True).train()
    assert_same_state(tmp_path / "stopped", tmp_path / "unbroken")


def test_a_requeued_job_starts_as_the_policy_it_is_given(first, tmp_path):
    begun, again = (session(tmp_path / str(k), init=str(first), resume=bool(k)).run.learner for k in (0, 1))
    np.testing.assert_array_equal(begun.policy.normalizer.mean, again.policy.normalizer.mean)
    assert float(again.policy.normalizer.samples) == NumpyPolicy.load(first / "best.npz").samples


def stop_after(iterations, begun):
    """Train so far and no further, as a signal would have it."""
    begun.config = replace(begun.config, ppo=replace(TINY, iterations=iterations))
    begun.train()


def test_a_disturbed_run_resumes_exactly(tmp_path):
    session(tmp_path / "unbroken", walk=ALL).train()
    stop_after(1, session(tmp_path / "stopped", walk=ALL))
    session(tmp_path / "stopped", walk=ALL, resume=True).train()
    assert_same_state(tmp_path / "stopped", tmp_path / "unbroken")
    assert json.loads((tmp_path / "stopped" / "config.json").read_text())["config"]["walk.scenario.push_n"] == 100


def test_the_best_policy_is_that_of_the_highest_return_and_under_disturbances_the_last(tmp_path, monkeypatch):
    falling = ({"return_plain": 0.0, "return_weighted": value, "steps": 0.0} for value in (9.0, 8.0, 7.0, 6.0))
    monkeypatch.setattr("cassie_mjx.training.runner.walk_returns", lambda *_: next(falling))
    for name, walk in (("calm", WalkConfig()), ("rough", ALL)):
        session(tmp_path / name, walk=walk, evaluate_every=1).train()
    kept = [NumpyPolicy.load(tmp_path / name / "best.npz").provenance["return_weighted"] for name in ("calm", "rough")]
    assert kept == [9.0, 6.0]


@pytest.mark.parametrize("name", ["nowhere", "empty"])
def test_a_policy_that_is_not_there_is_refused_before_anything_is_written(tmp_path, name):
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=f"init=.*{name} is none of 0x, .*, nor a policy's .npz file, nor a run"):
        session(tmp_path / "run", init=str(tmp_path / name))
    assert not (tmp_path / "run").exists()


def test_a_policy_of_other_layers_is_refused(first, tmp_path):
    with pytest.raises(ValueError, match=r"has hidden layers of \[16, 16\]; set ppo.hidden_sizes to that."):
        Runner(TrainConfig(init=str(first), run_dir=str(tmp_path / "run")), Console(file=io.StringIO()))
    assert not (tmp_path / "run").exists()
