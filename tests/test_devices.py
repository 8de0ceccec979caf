"""Several devices, and several processes: one learner, a share of the robots each, one process that writes.

A function of this file whose name begins with `with_` runs in processes of its own, which have two devices in all.
"""

import io
import json
import os
import signal
import socket
import subprocess
import sys
import time
import zlib
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from cassie_mjx.motion.files import load_motion
from cassie_mjx.physics.mjx import MjxPhysics
from cassie_mjx.ppo import learner, rollout
from cassie_mjx.ppo.config import PPOConfig
from cassie_mjx.robot.model import MJX_TRAINING, load_mjx_model
from cassie_mjx.training import checkpoint, devices, run_directory
from cassie_mjx.training.config import TrainConfig, resolve_config
from cassie_mjx.training.runner import Runner
from cassie_mjx.training.trainer import Trainer, iterate, learn

ROOT = Path(__file__).parents[1]

CONFIG = PPOConfig(
    num_robots=8,
    num_steps=4,
    iterations=2,
    updates_per_iteration=2,
    # The whole batch, so that how each device shuffles its own robots does not matter.
    minibatch_size=32,
    hidden_sizes=(16,),
    normalizer_samples=48,
)
RECURRENT = replace(CONFIG, network="gru")


def environment(**variables):
    paths = [str(ROOT), str(ROOT / "tests")]
    cache = str(jax.config.jax_compilation_cache_dir)
    common = {"JAX_PLATFORMS": "cpu", "PYTHONPATH": os.pathsep.join(paths), "JAX_COMPILATION_CACHE_DIR": cache}
    return os.environ | common | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"} | variables


STARTED: list[subprocess.Popen[str]] = []


@pytest.fixture(autouse=True)
def nothing_left_running():
    yield
    for process in STARTED:
        process.kill()


def python(*arguments, **variables):
    env, pipe = environment(**variables), subprocess.PIPE
    STARTED.append(subprocess.Popen([sys.executable, *arguments], env=env, stdout=pipe, stderr=pipe, text=True))
    return STARTED[-1]


def two_devices(*arguments):
    return [python(*arguments, XLA_FLAGS="--xla_force_host_platform_device_count=2")]


def two_processes(*arguments):
    """Start a command twice, as `srun --ntasks=2` does."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = str(free.getsockname()[1])
    step = {"SLURM_JOB_ID": "1", "SLURM_STEP_NODELIST": "localhost", "SLURM_NTASKS": "2", "JAX_COORDINATOR_PORT": port}
    return [python(*arguments, **step, SLURM_PROCID=str(i), SLURM_LOCALID=str(i)) for i in range(2)]


def finish(processes):
    """The output of each process, once all have ended well."""
    outputs = [process.communicate() for process in processes]
    assert [process.returncode for process in processes] == [0] * len(processes), outputs
    return [output for output, _ in outputs]


def call(function, *arguments):
    return "-c", f"import sys, test_devices; test_devices.{function.__name__}(*sys.argv[1:])", *map(str, arguments)


class Points(NamedTuple):
    """Robots that are points, pushed by action and noise; their episodes never end."""

    observation: Any
    final_observation: Any
    privileged: Any
    final_privileged: Any
    reward: Any
    terminated: Any
    truncated: Any
    metrics: Any


def points(position):
    ended = jnp.zeros(len(position), bool)
    return Points(
        position, position, position[:, :0], position[:, :0], -jnp.square(position).sum(axis=1), ended, ended, {}
    )


def step(state, action, key):
    return points(state.observation + action + jax.random.normal(key, action.shape))


def shards(leaf):
    return [np.asarray(shard.data) for shard in leaf.addressable_shards]


def assert_same_everywhere(tree):
    held = [{shard.tobytes() for shard in shards(leaf)} for leaf in jax.tree.leaves(tree)]
    assert [len(copies) for copies in held] == [1] * len(held)
    assert len(set(devices.exchange(zlib.crc32(b"".join(copy for (copy,) in held))))) == 1


def with_two_devices_a_point_robot_is_trained(distributed, network):
    if distributed == "True":
        devices.join()
    config = replace(CONFIG, network=network)
    collect, update = partial(rollout.collect, step, config), partial(learner.update, config)
    collect_on_all, update_on_all = devices.on_all(collect, update)
    share = jax.random.normal(jax.random.key(0), (4, 3))
    state = learner.init(jax.random.key(1), config, 3, 3, 0)
    placed = jax.device_put(state, devices.same_everywhere())
    robots = rollout.begin(state.policy, points(jnp.concatenate([share, share])))
    start = jax.device_put(robots, devices.split_by_robot())

    # Both devices start from the same robots, and each collects what one device would with its key.
    key = jax.random.key(2)
    _, lived = collect_on_all(placed.policy, start, key)
    whole = jax.tree.map(np.asarray, devices.gather(lived))
    for shard, (robots, own_key) in zip(np.split(whole.action, 2, axis=1), devices.shares(start, key, 2), strict=True):
        assert np.array_equal(robots.env.observation, share)
        _, alone = collect(state.policy, robots, own_key)
        np.testing.assert_allclose(shard, alone.action, rtol=1e-5)
    assert not (whole.action[:, :4] == whole.action[:, 4:]).any()

    together, alone = jax.jit(update_on_all)(placed, lived, key), update(state, whole, key)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-6), alone, together)
    assert_same_everywhere(together)

    gathered = rollout.random_policy_statistics(collect_on_all, placed.policy, start, key, CONFIG.normalizer_samples)
    random = placed.policy._replace(actor=jax.tree.map(jnp.zeros_like, placed.policy.actor))
    middle, first = collect_on_all(random, start, jax.random.fold_in(key, 0))
    _, second = collect_on_all(random, middle, jax.random.fold_in(key, 1))
    seen = np.concatenate([devices.gather(lived.observation) for lived in (first, second)]).reshape(-1, 3)
    assert gathered.samples == len(seen) == 64
    np.testing.assert_allclose(gathered.mean, seen.mean(axis=0), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(gathered.squares / gathered.samples, seen.var(axis=0), rtol=1e-4)


@pytest.mark.parametrize("start", [two_devices, pytest.param(two_processes, marks=pytest.mark.slow)])
@pytest.mark.parametrize("network", ["mlp", "gru"])
def test_two_devices_share_robots_and_learn_as_one(start, network):
    finish(start(*call(with_two_devices_a_point_robot_is_trained, start is two_processes, network)))


def go_on_elsewhere(folder, number):
    """Restore checkpoint `number` on the devices of this process, bit for bit, learn once more and save the next."""
    folder, number = Path(folder), int(number)
    collect, update = partial(rollout.collect, step, RECURRENT), partial(learner.update, RECURRENT)
    places: Any = None
    if jax.device_count() > 1:
        collect, update = devices.on_all(collect, update)
        places = devices.same_everywhere(), devices.split_by_robot()
    state = learner.init(jax.random.key(1), RECURRENT, 3, 3, 0)
    run = state, rollout.begin(state.policy, points(jnp.zeros((8, 3))))
    run = jax.device_put(run, places) if places else run
    arrays = checkpoint.restore(folder / f"step_{number:06d}").arrays
    state, robots = run = checkpoint.restore_into(run, arrays)
    held = {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(devices.gather(run))}
    assert all(np.array_equal(held[name], arrays[name]) for name in arrays)
    assert len(robots.env.observation.sharding.device_set) == jax.device_count()
    assert number == 0 or np.abs(robots.hidden).max() > 0.01
    robots, lived = collect(state.policy, robots, jax.random.key(number))
    state, metrics = jax.jit(update)(state, lived, jax.random.key(number))
    assert np.isfinite(jax.tree.leaves(jax.device_get(metrics))).all()
    assert int(state.iteration) == number + 1
    checkpoint.save(folder, number + 1, devices.gather((state, robots)), load_motion("walk"), {})


def test_a_checkpoint_goes_on_with_more_devices_and_with_fewer(tmp_path):
    state = learner.init(jax.random.key(1), RECURRENT, 3, 3, 0)
    robots = rollout.begin(state.policy, points(jax.random.normal(jax.random.key(0), (8, 3))))
    checkpoint.save(tmp_path, 0, (state, robots), load_motion("walk"), {})
    go_on_elsewhere(tmp_path, 0)
    finish(two_devices(*call(go_on_elsewhere, tmp_path, 1)))
    go_on_elsewhere(tmp_path, 2)


def with_any_devices_a_run_goes_on(folder, iterations):
    """Train a run on MJX up to `iterations`, from its last checkpoint if it has one, and save there."""
    sizes = {"num_robots": 2, "num_steps": 4, "minibatch_size": 8, "iterations": 3, "normalizer_samples": 8}
    ppo, folder = replace(CONFIG, **sizes), Path(folder)
    config = TrainConfig(physics="mjx", physics_hz=500, ppo=ppo, evaluate_every=3, resume=True, run_dir=str(folder))
    runner = Runner(config, Console(file=io.StringIO()))
    if runner.done:
        arrays, held = last_state(folder), devices.gather(runner.run)
        leaves = {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(held)}
        assert all(np.array_equal(leaves[name], arrays[name]) for name in arrays)
    assert len(runner.run.env.physics.qpos.sharding.device_set) == jax.device_count()
    runner.config = replace(runner.config, ppo=replace(ppo, iterations=int(iterations)))
    runner.train()
    assert runner.done == int(iterations)


@pytest.mark.slow
def test_a_run_goes_on_with_more_devices_and_with_fewer(tmp_path):
    finish([python(*call(with_any_devices_a_run_goes_on, tmp_path, 1))])
    finish(two_devices(*call(with_any_devices_a_run_goes_on, tmp_path, 2)))
    finish([python(*call(with_any_devices_a_run_goes_on, tmp_path, 3))])


def with_two_processes_everything_is_shared(folder):
    devices.join()
    devices.join()  # a second run of a sweep
    me = jax.process_index()
    assert devices.is_first() == (me == 0)
    assert devices.exchange(2**32 - 1 - me) == [2**32 - 1, 2**32 - 2]

    whole = {"robots": np.arange(8.0).reshape(4, 2), "weights": np.arange(3.0)}
    places = {"robots": devices.split_by_robot(), "weights": devices.same_everywhere()}
    placed = jax.device_put(whole, places)
    assert np.array_equal(placed["robots"].addressable_data(0), whole["robots"][2 * me : 2 * me + 2])
    jax.tree.map(np.testing.assert_array_equal, devices.gather(placed), whole)
    assert np.array_equal(devices.own_copy(placed["weights"]), whole["weights"])
    saved, gathered = Path(folder) / "checkpoints", devices.gather(placed)
    if devices.is_first():
        checkpoint.save(saved, 1, gathered, load_motion("walk"), {})
    devices.exchange(0)
    arrays = checkpoint.restore(saved / "step_000001").arrays
    restored = checkpoint.restore_into(jax.device_put(jax.tree.map(np.zeros_like, whole), places), arrays)
    assert restored["robots"].sharding == placed["robots"].sharding
    jax.tree.map(np.testing.assert_array_equal, devices.gather(restored), whole)

    own = {"position": np.array([[me + 1 / 3, np.pi]]), "history": np.zeros((1, 0, 67)), "moving": np.array([me == 1])}
    whole = devices.gather(own)
    assert {name: rows.dtype for name, rows in whole.items()} == {name: rows.dtype for name, rows in own.items()}
    assert np.array_equal(whole["position"], [[1 / 3, np.pi], [4 / 3, np.pi]])
    assert (whole["history"].shape, whole["moving"].tolist()) == ((2, 0, 67), [False, True])
    jax.tree.map(np.testing.assert_array_equal, devices.share_of_host(whole), own)
    with pytest.raises(ValueError, match="num_robots is 9; it must be a multiple of the 2 devices."):
        resolve_config(TrainConfig(physics="native", ppo=replace(CONFIG, num_robots=9)))
    config, private = resolve_config(TrainConfig(physics="mjx", resume=True)), Path(folder) / str(me)
    for claimed in (Path(folder) / "shared", private):
        claim = run_directory.claim(claimed, config, {"process": me})
        assert (claim.restored, claim.notes) == (None, [])
    assert json.loads((Path(folder) / "shared" / "config.json").read_text())["provenance"] == {"process": 0}
    assert private.exists() == (me == 0)
    if me == 0:
        (private / "checkpoints" / "step_000001").mkdir(parents=True)
    with pytest.raises(ValueError, match="is not the same directory on all hosts; choose a run_dir that they share"):
        run_directory.claim(private, config, {})

    MjxPhysics(load_mjx_model(MJX_TRAINING))


def test_two_processes_share_arrays_and_a_directory(tmp_path):
    finish(two_processes(*call(with_two_processes_everything_is_shared, tmp_path)))


ON_THE_HOST = TrainConfig(physics="native", physics_hz=500, ppo=CONFIG)


def with_two_processes_cassie_learns_on_the_host(file):
    devices.join()
    trainer = Trainer(resolve_config(ON_THE_HOST), load_motion("walk"))
    run = trainer.start()
    assert run.env.physics.qpos.shape == (4, 35)
    run, metrics = trainer.iterate(trainer.gather_statistics(run))
    assert_same_everywhere((run.learner, run.key))
    lost = run.env.physics.qpos.copy()
    lost[1] = np.nan if jax.process_index() else lost[1]
    found = trainer.replay(run._replace(env=replace(run.env, physics=replace(run.env.physics, qpos=lost))))
    assert found is not None
    assert np.isnan(found["qpos"]).all()
    placed = trainer.place(devices.gather(run))
    jax.tree.map(np.testing.assert_array_equal, (placed.env, own(placed.learner)), (run.env, own(run.learner)))
    whole = devices.gather(run)
    if devices.is_first():
        np.savez(file, *jax.tree.leaves((whole, jax.device_get(metrics))))


def own(tree):
    return jax.device_get(devices.own_copy(tree))


@pytest.mark.slow
def test_two_processes_on_the_host_learn_as_one_with_all_robots(tmp_path):
    """The one process draws what happens to each half of its robots from the key that a process has for its half."""
    trainer = Trainer(resolve_config(ON_THE_HOST), load_motion("walk"))
    collect_all = trainer.collect

    def collect(policy, robots, key):
        halves = [collect_all(policy, *each) for each in devices.shares(robots, key, 2)]
        (first, one), (second, other) = halves
        joined = jax.tree.map(lambda *rows: np.concatenate(rows), first, second)
        return joined, jax.tree.map(lambda *rows: np.concatenate(rows, axis=1), one, other)

    trainer.collect = collect
    started = trainer.gather_statistics(trainer.start())
    alone = iterate(collect, partial(learn, partial(learner.update, CONFIG)), started)
    finish(two_processes(*call(with_two_processes_cassie_learns_on_the_host, tmp_path / "run.npz")))
    with np.load(tmp_path / "run.npz") as together:
        pairs = list(zip(jax.tree.leaves(jax.device_get(alone)), together.values(), strict=True))
    for ours, theirs in pairs:
        np.testing.assert_allclose(theirs, ours, rtol=1e-4, atol=1e-5)
    # What learning changes by is far more than that.
    before, after = (jax.tree.leaves(run.learner.policy.actor) for run in (started, alone[0]))
    assert max(np.abs(a - b).max() for a, b in zip(before, after, strict=True)) > 3e-4


@pytest.mark.parametrize("sizes", [{"num_robots": 9}, {"minibatch_size": 31}])
def test_what_does_not_divide_among_the_devices_is_refused_before_anything_is_compiled(monkeypatch, sizes):
    monkeypatch.setattr(jax, "device_count", lambda: 2)
    ((name, value),) = sizes.items()
    with pytest.raises(ValueError, match=f"{name} is {value}; it must be a multiple of the 2 devices."):
        resolve_config(TrainConfig(physics="mjx", ppo=replace(CONFIG, **sizes)))
    assert resolve_config(TrainConfig(physics="native", ppo=replace(CONFIG, **sizes))).physics == "native"
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    with pytest.raises(ValueError, match=f"{name} is {value}; it must be a multiple of the 2 devices."):
        resolve_config(TrainConfig(physics="native", ppo=replace(CONFIG, **sizes)))


def test_the_command_says_so_too(tmp_path):
    arguments = ["-m", "cassie_mjx.train", "physics=mjx", "ppo.num_robots=129", f"run_dir={tmp_path / 'run'}"]
    (process,) = two_devices(*arguments)
    _, complaint = process.communicate()
    assert process.returncode == 2
    assert complaint == "error: num_robots is 129; it must be a multiple of the 2 devices.\n"
    assert not (tmp_path / "run").exists()


def test_without_a_cluster_there_is_nothing_to_join():
    process = python("-m", "cassie_mjx.train", "distributed=true")
    _, complaint = process.communicate()
    assert process.returncode == 2
    assert complaint.startswith("error: distributed=true found no other processes")
    assert len(complaint.splitlines()) == 1


def with_two_devices_cassie_is_trained():
    motion = load_motion("walk")
    config = resolve_config(
        TrainConfig(physics="mjx", physics_hz=500, ppo=replace(CONFIG, num_robots=4, minibatch_size=16))
    )
    trainer = Trainer(config, motion)
    run = trainer.gather_statistics(trainer.start())
    for _ in range(2):
        run, metrics = trainer.iterate(run)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(jax.device_get(metrics)))
    assert trainer.iterate._cache_size() == 1
    assert run.learner.iteration == 2
    assert_same_everywhere((run.learner, run.key))
    first, second = shards(run.env.physics.qpos)
    assert len(first) == len(second) == 2
    assert abs(first - second).max() > 1e-3

    # Robot 3, the second one of the second device, is what a replay finds.
    lost = np.asarray(run.env.physics.qpos).copy()
    lost[3] = np.nan
    lost = jax.device_put(lost, devices.split_by_robot())
    found = trainer.replay(run._replace(env=replace(run.env, physics=replace(run.env.physics, qpos=lost))))
    assert found is not None
    assert np.isnan(found["qpos"]).all()
    assert np.array_equal(found["qvel"], np.asarray(run.env.physics.qvel)[3])


@pytest.mark.slow
def test_cassie_is_trained_on_two_devices():
    finish(two_devices(*call(with_two_devices_cassie_is_trained)))


def train(folder, physics, *arguments):
    sizes = {"num_robots": 2, "num_steps": 4, "minibatch_size": 8, "iterations": 6, "updates_per_iteration": 2}
    learning = [f"ppo.{name}={value}" for name, value in sizes.items()]
    run = [
        f"physics={physics}",
        "physics_hz=500",
        "evaluate_every=1",
        "ppo.hidden_sizes=[16]",
        "ppo.normalizer_samples=8",
    ]
    return "-m", "cassie_mjx.train", "distributed=true", *run, *learning, f"run_dir={folder}", *arguments


def last_state(folder):
    return checkpoint.restore(checkpoint.latest(folder / "checkpoints") or pytest.fail("no checkpoint")).arrays


@pytest.mark.slow
@pytest.mark.parametrize("physics", ["mjx", "native"])
def test_two_processes_train_stop_together_and_go_on(tmp_path, physics):
    unbroken, broken = tmp_path / "unbroken", tmp_path / "broken"
    spoken, silent = finish(two_processes(*train(unbroken, physics)))
    assert "6 iterations of 8 samples" in spoken
    assert "Done: a return of" in spoken
    assert "Done" not in silent

    first, second = two_processes(*train(broken, physics, "resume=true"))
    while not ((broken / "metrics.jsonl").exists() and (broken / "metrics.jsonl").read_text()):
        assert first.poll() is second.poll() is None
        time.sleep(0.1)
    second.send_signal(signal.SIGTERM)
    outputs = [process.communicate() for process in (first, second)]
    assert [first.returncode, second.returncode] == [128 + signal.SIGTERM] * 2, outputs
    assert "Stopped and saved after iteration" in outputs[0][0]
    assert "iteration 6/6" not in outputs[0][0]

    assert "Resuming" in finish(two_processes(*train(broken, physics, "resume=true")))[0]
    ours, theirs = last_state(broken), last_state(unbroken)
    assert ours.keys() == theirs.keys()
    assert all(np.array_equal(ours[name], theirs[name]) for name in ours)
    lines = [json.loads(line)["train/iteration"] for line in (broken / "metrics.jsonl").read_text().splitlines()]
    assert lines == [1, 2, 3, 4, 5, 6]
