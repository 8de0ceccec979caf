"""Training runs: exact resume, signals, run directories, command lines, and what a NaN does."""

import io
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest
import tiny
from rich.console import Console

from cassie_mjx import cli, train
from cassie_mjx.agents.numpy_policy import NumpyPolicy
from cassie_mjx.agents.policy_file import save_policy
from cassie_mjx.envs.config import WALK_PRESETS
from cassie_mjx.motion.command import speed_factor, speed_factors
from cassie_mjx.motion.files import load_motion
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.ppo.config import PPO_PRESETS
from cassie_mjx.training import checkpoint, run_directory, runner
from cassie_mjx.training.config import PRESETS, RENAMED, TrainConfig, resolve_config
from cassie_mjx.training.loggers import Terminal
from cassie_mjx.training.runner import Runner
from cassie_mjx.training.trainer import Trainer

TINY = replace(tiny.TINY, iterations=6)


def config(folder, **changes):
    return tiny.config(folder, **{"ppo": TINY} | changes)


def session(folder, **changes):
    return tiny.session(folder, **{"ppo": TINY} | changes)


def lines(folder):
    """The metrics of a run without the times, which no two runs share."""
    values = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [{name: value for name, value in line.items() if not name.startswith("time/")} for line in values]


def last_checkpoint(folder):
    return checkpoint.latest(folder / "checkpoints") or pytest.fail("no checkpoint")


def last_state(folder):
    return checkpoint.restore(last_checkpoint(folder)).arrays


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    folder = tmp_path_factory.mktemp("unbroken")
    session(folder).train()
    return folder


def at_iteration(monkeypatch, iteration, action):
    """Run `action` once, as that iteration ends."""
    advance, calls = Terminal.advance, iter(range(1, 1000))

    def patched(self, *args):
        advance(self, *args)
        if next(calls) == iteration:
            action()

    monkeypatch.setattr(Terminal, "advance", patched)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_run_stopped_by_a_signal_goes_on_as_if_it_had_not_been(unbroken, tmp_path, monkeypatch, number):
    before = signal.getsignal(number)
    with monkeypatch.context() as patched:
        at_iteration(patched, 3, lambda: os.kill(os.getpid(), number))
        stopped = session(tmp_path)
        with pytest.raises(SystemExit, match=str(128 + number)):
            stopped.train()
    assert signal.getsignal(number) is before
    assert "Stopped and saved after iteration 3. To go on:" in stopped.terminal._console.file.getvalue()
    assert last_checkpoint(tmp_path).name == "step_000003"

    session(tmp_path, resume=True).train()
    ours, theirs = last_state(tmp_path), last_state(unbroken)
    assert ours.keys() == theirs.keys()
    assert all(np.array_equal(ours[name], theirs[name]) for name in ours)
    assert lines(tmp_path) == lines(unbroken)
    assert best_weights(tmp_path) == best_weights(unbroken)


def best_weights(folder):
    return [array.tolist() for layer in NumpyPolicy.load(folder / "best.npz").weights for array in layer]


def test_a_run_that_died_between_checkpoints_goes_on_from_the_last(unbroken, tmp_path, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr("cassie_mjx.training.runner.save_policy", die_at_the_second_evaluation())
        with pytest.raises(RuntimeError):
            session(tmp_path).train()
    # The second line of metrics was written, the checkpoint that belongs to it was not.
    assert len(lines(tmp_path)) == 2
    assert last_checkpoint(tmp_path).name == "step_000002"
    session(tmp_path, resume=True).train()
    assert lines(tmp_path) == lines(unbroken)


def die_at_the_second_evaluation():

    def save(path, policy, motion, speed, kd_scale, provenance, *rest):
        if provenance["samples"] == 4 * TINY.num_samples:
            raise RuntimeError
        save_policy(path, policy, motion, speed, kd_scale, provenance, *rest)

    return save


def test_a_run_holds_everything(unbroken):
    held = json.loads((unbroken / "config.json").read_text())
    assert held["config"]["ppo.num_robots"] == 4
    assert held["config"]["physics_hz"] == 500
    assert held["provenance"]["versions"]["jax"] == jax.__version__
    line = json.loads((unbroken / "metrics.jsonl").read_text().splitlines()[-1])
    assert line["train/samples"] == 6 * 32
    assert line["time/train_s"] > 0
    assert {"eval/return_plain", "eval/return_weighted", "time/physics_steps_per_s"} <= line.keys()
    assert {
        "train/nan",
        "train/fallen",
        "train/low_reward",
        "train/position_error",
        "learner/action_std",
    } <= line.keys()
    shares = [line[f"time/{name}_share"] for name in ("physics", "learner", "eval")]
    assert min(shares) > 0
    assert sum(shares) < 1
    assert (unbroken / "last.npz").exists()
    assert list((unbroken / "tensorboard").iterdir())


def test_the_guide_lists_every_number_of_a_run(unbroken):
    page = (Path(__file__).parents[1] / "docs" / "numbers.md").read_text()
    listed = re.findall(r"^\| `((?:train|time|eval|learner)/\w+)` \|", page, re.M)
    assert sorted(listed) == sorted(json.loads((unbroken / "metrics.jsonl").read_text().splitlines()[-1]))


def test_the_best_policy_is_that_of_the_best_line(unbroken):
    best = max(line["eval/return_weighted"] for line in lines(unbroken))
    assert NumpyPolicy.load(unbroken / "best.npz").provenance["return_weighted"] == best


def test_a_finished_run_resumes_to_its_end_at_once(unbroken):
    before = lines(unbroken)
    again = session(unbroken, resume=True)
    again.train()
    assert "Done: a return of" in again.terminal._console.file.getvalue()
    assert lines(unbroken) == before


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({}, "holds this run already; to go on with it: python -m cassie_mjx.train .*resume=true"),
        ({"seed": 1}, "holds another run, with seed=0; choose another run_dir"),
        ({"ppo": replace(TINY, gamma=0.9), "resume": True}, "holds another run, with ppo.gamma=0.99;"),
    ],
)
def test_a_directory_that_holds_a_run_is_refused_untouched(unbroken, changes, sentence):
    before = contents(unbroken)
    with pytest.raises(ValueError, match=sentence):
        Runner(replace(config(unbroken), **changes), Console(file=io.StringIO()))
    assert contents(unbroken) == before


def test_a_run_of_another_version_is_refused(unbroken, tmp_path):
    run = shutil.copytree(unbroken, tmp_path / "run")
    held = json.loads((run / "config.json").read_text())
    held["config"]["ppo.old"] = held["config"].pop("walk.max_position_error_m")
    (run / "config.json").write_text(json.dumps(held))
    sentence = (
        r"a run of another version of this program, with other settings \(ppo.old, walk.max_position_error_m\); choose"
    )
    with pytest.raises(ValueError, match=sentence):
        session(run, resume=True)


def test_resume_starts_a_run_where_there_is_nothing_yet(tmp_path):
    (tmp_path / "empty").mkdir()
    for folder in (tmp_path / "missing", tmp_path / "empty"):
        assert session(folder, resume=True).done == 0
        assert json.loads((folder / "config.json").read_text())["config"]["seed"] == 0


def test_files_of_something_else_are_no_run_to_resume(tmp_path):
    (tmp_path / "metrics.jsonl").write_text("precious")
    with pytest.raises(ValueError, match="holds files, but no run to resume; choose another run_dir"):
        session(tmp_path, resume=True)
    assert contents(tmp_path) == {tmp_path / "metrics.jsonl": b"precious"}


def test_a_run_that_died_before_its_first_checkpoint_starts_anew(tmp_path):
    session(tmp_path)
    resumed = session(tmp_path, resume=True)
    assert (resumed.done, resumed.saved) == (0, None)


def test_a_directory_that_cannot_be_used_is_refused_in_one_sentence(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match=r"^The run directory .*file cannot be written \(File exists\).$"):
        session(tmp_path / "file")
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(ValueError, match=r"config.json cannot be read \(.*\); choose another run_dir.$"):
        session(tmp_path)


def test_a_missing_reference_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(ValueError, match=r"missing\.npz"):
        session(tmp_path / "run", reference="missing.npz")
    assert not (tmp_path / "run").exists()


def test_a_nan_in_physics_is_counted_survived_and_kept(tmp_path, monkeypatch):
    advance = NativePhysics.advance

    def patched(self, state, target, scenario, n_steps):
        after = advance(self, state, target, scenario, n_steps)
        # A robot of the four diverges in the third control step of each of its episodes; the evaluation has ten.
        if len(state.qpos) == 4 and state.step[1] == 2 * n_steps:
            after.qpos[1] = np.nan
        return after

    with monkeypatch.context() as patches:
        patches.setattr(NativePhysics, "advance", patched)
        running = session(tmp_path)
        running.train()
    # Of the steps 1 to 16, 17 to 32 and 33 to 48 between evaluations, every third.
    assert [line["train/nan"] for line in lines(tmp_path)] == [5, 5, 6]
    assert all(np.isfinite(array).all() for array in last_state(tmp_path).values())
    said = running.terminal._console.file.getvalue()
    assert "Physics diverged in iteration 1, which ended an episode; the model and the state before it are in" in said
    assert said.count("diverged") == 1
    assert np.load(tmp_path / "nan" / "before.npz")["step"] == 2 * 16


def test_a_divergence_that_does_not_recur_is_looked_for_once(tmp_path, monkeypatch):
    advance, replays = NativePhysics.advance, []

    def patched(self, state, target, scenario, n_steps):
        after = advance(self, state, target, scenario, n_steps)
        if len(state.qpos) == 4:
            after.qpos[1] = np.nan
        return after

    monkeypatch.setattr(NativePhysics, "advance", patched)
    monkeypatch.setattr(Trainer, "replay", lambda self, before: replays.append(before))
    running = session(tmp_path)
    running.train()
    assert len(replays) == 1
    assert "it did not recur in a replay" in running.terminal._console.file.getvalue()


def test_auto_takes_mjx_on_an_accelerator_alone(monkeypatch):
    assert resolve_config(TrainConfig()).physics == "native"
    assert resolve_config(TrainConfig()).run_dir == "runs/1x-seed0"
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert resolve_config(TrainConfig()).physics == "mjx"
    assert resolve_config(TrainConfig()).physics_hz == 1000
    assert resolve_config(TrainConfig(physics="native")).physics == "native"


@pytest.mark.slow
def test_an_iteration_on_mjx_is_one_compiled_call(tmp_path):
    tiny = replace(TINY, num_robots=2, num_steps=4, minibatch_size=8, iterations=2, normalizer_samples=8)
    running = Runner(
        TrainConfig(ppo=tiny, physics="mjx", physics_hz=500, run_dir=str(tmp_path)), Console(file=io.StringIO())
    )
    running.train()
    assert running.done == 2
    assert running.trainer.iterate._cache_size() == 1


# Command lines


def command(monkeypatch, main, *arguments):
    monkeypatch.setattr(sys, "argv", ["train", *arguments])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    cli.run(main, TrainConfig, {key: cli.Group(*presets) for key, presets in PRESETS.items()}, RENAMED)


def configs(monkeypatch, tmp_path, *arguments):
    monkeypatch.chdir(tmp_path)
    seen = []
    command(monkeypatch, seen.append, *arguments)
    return seen


def test_a_command_line_is_the_configuration(monkeypatch, tmp_path):
    assert configs(monkeypatch, tmp_path) == [TrainConfig()]
    arguments = ["speed=1.5x", "ppo=paper", "ppo.clip_epsilon=0.1", "walk.min_reward=null", "seed=3"]
    (seen,) = configs(monkeypatch, tmp_path, *arguments)
    assert seen.ppo == replace(PPO_PRESETS["paper"], clip_epsilon=0.1)
    assert (seen.speed, seen.seed, seen.walk.min_reward) == ("1.5x", 3, None)
    assert not list(tmp_path.iterdir()), "Hydra leaves nothing behind"


def test_robustness_is_a_preset_of_the_task(monkeypatch, tmp_path):
    (seen,) = configs(monkeypatch, tmp_path, "walk=robust", "walk.scenario.push_n=180", "init=1x")
    robust = WALK_PRESETS["robust"]
    assert seen.walk == replace(robust, scenario=replace(robust.scenario, push_n=180.0))
    assert robust.scenario.active
    assert not TrainConfig().walk.scenario.active
    assert seen.init == "1x"


def test_a_sweep_runs_every_combination(monkeypatch, tmp_path):
    seen = configs(monkeypatch, tmp_path, "-m", "seed=0,1", "speed=1x,2x")
    assert [(each.seed, each.speed) for each in seen] == [(0, "1x"), (0, "2x"), (1, "1x"), (1, "2x")]


@pytest.mark.parametrize(
    ("argument", "sentence"),
    [
        ("sped=2x", "'sped' is not a key; the keys are speed, command, physics, physics_hz, contacts, seed,"),
        ("ppo.clip=1", "'ppo.clip' is not a key; the keys are num_robots, num_steps,"),
        ("+song=1", "'+song' is not a key; the keys are speed,"),
        ("walk.scenario.wind=1", "'walk.scenario.wind' is not a key; the keys are push_n,"),
        ("walk.scenario.push_n=-1", "walk.scenario.push_n=-1.0 must be from 0 to 1,000."),
        ("ppo=huge", "ppo=huge is not known; choose one of paper, parallel, massive."),
        ("hydra/launcher=slurm", "'hydra/launcher' is not a key; the keys are speed,"),
        ("seed=one", "seed=one: 'one' is not a whole number."),
        ("speed", "'speed' is not of the form key=value; the keys are speed,"),
        ("seed=0,1", "seed=0,1: '0,1' is not a whole number; -m seed=0,1 runs one after another."),
        ("speed=9x", "speed=9x is not a speed; give a factor from 0x to 4x, such as 2x or 1.5x, or any"),
        ("speed=fast", "speed=fast is not a speed"),
        ("physics=bullet", "physics=bullet is not known; choose one of auto, native, mjx."),
        ("physics_hz=300", "physics_hz=300 does not divide"),
        ("evaluate_every=0", "evaluate_every=0 must be a whole number from 1 to 1,000,000, or null."),
        ("ppo.clip_epsilon=-1", "ppo.clip_epsilon=-1.0 must be from 0.0001 to 100."),
        ("physics_hz=1000000000", "physics_hz=1000000000 must be a whole number from 100 to 20,000, or null."),
        ("walk=5", "walk=5 is not known; choose one of undisturbed, robust, joystick."),
        ("ppo=null", "ppo=null is not known; choose one of paper, parallel, massive."),
        ("=1", "'' is not a key; the keys are speed,"),
        ("walk.=1", "'walk.' is not a key; the keys are reward,"),
        ("init=", "init is empty; name one, or null."),
        ("walk.reward=song", "walk.reward=song is not known; choose one of plain, weighted."),
    ],
)
def test_a_wrong_command_line_is_refused_in_one_sentence(monkeypatch, capsys, argument, sentence):
    with pytest.raises(SystemExit, match="2"):
        command(monkeypatch, pytest.fail, argument)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {sentence}")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["hydra/launcher=slurm", "seed=0,1"], "hydra/launcher=slurm is not known; choose one of basic."),
        (["seed"], "'seed' is not of the form key=value."),
    ],
)
def test_a_wrong_sweep_is_refused_in_one_sentence(monkeypatch, capsys, arguments, sentence):
    with pytest.raises(SystemExit, match="2"):
        command(monkeypatch, print, "-m", *arguments)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {sentence}")


def test_a_sweep_trains_one_run_after_another(monkeypatch, tmp_path, capsys):
    def train_quietly(asked):
        Runner(asked, Console(file=io.StringIO())).train()

    monkeypatch.chdir(tmp_path)
    small = [f"ppo.{name}={getattr(tiny.TINY, name)}" for name in ("num_robots", "num_steps", "iterations")]
    small += ["ppo.minibatch_size=16", "ppo.updates_per_iteration=3", "ppo.normalizer_samples=64"]
    arguments = ["-m", "seed=0,1", "physics=native", "ppo.hidden_sizes=[16,16]", *small]
    command(monkeypatch, train_quietly, *arguments)
    for seed in (0, 1):
        held = json.loads((tmp_path / f"runs/1x-seed{seed}/config.json").read_text())
        assert (held["config"]["seed"], held["config"]["ppo.hidden_sizes"]) == (seed, [16, 16])
        assert (tmp_path / f"runs/1x-seed{seed}/last.npz").exists()
    # What it then says goes on with both, and works.
    with pytest.raises(SystemExit, match="2"):
        command(monkeypatch, train_quietly, *arguments)
    on = capsys.readouterr().err.split("python -m cassie_mjx.train ")[1].splitlines()[0]
    command(monkeypatch, train_quietly, *shlex.split(on))


def test_how_to_go_on_is_a_command_of_the_same_kind(monkeypatch):
    for first, begins in (("/a/train.py", "python -m cassie_mjx.train"), ("cassie-mjx train", "cassie-mjx train")):
        monkeypatch.setattr(sys, "argv", [first, "resume=false", "init=a b.npz"])
        assert run_directory.resume_command() == f"{begins} 'init=a b.npz' resume=true"


def test_a_sweep_takes_presets_and_nested_keys(monkeypatch, tmp_path):
    seen = configs(monkeypatch, tmp_path, "-m", "walk=undisturbed,robust", "walk.scenario.push_n=5,7", "ppo=paper")
    assert [(each.walk.kd_scale, each.walk.scenario.push_n) for each in seen] == [
        *((1.0, 5.0), (1.0, 7.0), (0.3, 5.0), (0.3, 7.0))
    ]
    assert seen[0].ppo == PPO_PRESETS["paper"]


def test_old_names_of_keys_still_work(monkeypatch, tmp_path, capsys):
    old = ["walk.disturbance.push_n=120", "walk.early_end_reward=0.3", "walk.x_limit_m=null", "walk.damping=0.5"]
    (seen,) = configs(monkeypatch, tmp_path, *old)
    assert seen.walk.scenario.push_n == 120
    assert (seen.walk.min_reward, seen.walk.max_position_error_m, seen.walk.kd_scale) == (0.3, None, 0.5)
    assert "walk.damping is now called walk.kd_scale." in capsys.readouterr().err


def test_what_fails_in_a_run_ends_it_in_one_sentence(monkeypatch, capsys):
    def full(_):
        raise OSError("The checkpoint could not be written.")

    with pytest.raises(SystemExit, match="2"):
        command(monkeypatch, full)
    assert capsys.readouterr().err == "error: The checkpoint could not be written.\n"


def test_a_divergence_does_not_flood_the_terminal(monkeypatch, tmp_path, capfd, model):
    class Diverging:
        folder = None

        def __init__(self, *_):
            self.data = mujoco.MjData(model)
            self.data.qvel[:] = 1e12

        def train(self):
            mujoco.mj_step(model, self.data)

    monkeypatch.chdir(tmp_path)
    Diverging().train()
    assert "WARNING: Nan, Inf or huge value in QVEL" in "".join(capfd.readouterr())
    monkeypatch.setattr(runner, "Runner", Diverging)
    try:
        train.main(TrainConfig())
    finally:
        mujoco.set_mju_user_warning(None)
    assert "WARNING" not in "".join(capfd.readouterr())


def test_the_command_itself_ends_with_a_sentence_and_a_status(tmp_path):
    arguments = [sys.executable, "-m", "cassie_mjx.train", "speed=9x"]
    done = subprocess.run(arguments, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 2
    sentence = "speed=9x is not a speed; give a factor from 0x to 4x, such as 2x or 1.5x, or any for all of them."
    assert done.stderr == f"error: {sentence}\n"


def test_speeds():
    assert [speed_factor(text) for text in ("0x", "1.5x", "2", "4x")] == [0, 1.5, 2, 4]
    assert [speed_factors(text) for text in ("1.5x", "any")] == [(1.5, (1, 1)), (1, (0, 4))]
    for text in ("-1x", "4.1x", "nan", "x", ""):
        with pytest.raises(ValueError, match="is not a speed"):
            speed_factor(text)
        with pytest.raises(ValueError, match=r"such as 2x or 1\.5x, or any for all of them\.$"):
            speed_factors(text)
    # Only training draws speeds: a policy is told one.
    with pytest.raises(ValueError, match=r"speed=any is not a speed; give .* such as 2x or 1\.5x\.$"):
        speed_factor("any")


def test_a_policy_for_any_speed_is_saved_with_the_motion_as_recorded(tmp_path):
    session(tmp_path / "any", speed="any").train()
    session(tmp_path / "twice", speed="2x").train()
    recorded = load_motion("walk")
    for name, factor in (("any", 1), ("twice", 2)):
        saved = NumpyPolicy.load(tmp_path / name / "best.npz")
        assert saved.speed == factor
        assert saved.reference_stride_length == pytest.approx(factor * recorded.stride_length)
    speeds = last_state(tmp_path / "any")[".env.motion.command.forward"]
    assert len(set(speeds.tolist())) > 1
    np.testing.assert_allclose(
        last_state(tmp_path / "twice")[".env.motion.command.forward"], 2 * recorded.stride_length / 0.704, rtol=1e-5
    )


def test_every_choice_of_the_configuration_is_recorded(unbroken):
    held = json.loads((unbroken / "config.json").read_text())["config"]
    top = set(asdict(TrainConfig())) - {"resume", "run_dir", "distributed", "log", "video_every", "walk", "ppo"}
    assert top | {f"ppo.{name}" for name in asdict(TINY)} <= held.keys()
