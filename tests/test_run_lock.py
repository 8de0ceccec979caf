"""One training at a time in a run's directory, whoever else is there and however the last one ended."""

import errno
import fcntl
import json
import multiprocessing
import os
import socket

import pytest
import tiny

from cassie_mjx.training import lock, runner

CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(["cassie_mjx.training.lock"])


def enter(folder, rounds, together, outcomes):
    """Try to enter a directory at the same moment as others, once a round; stay until all have tried."""
    for each in range(rounds):
        together.wait(60)
        try:
            with lock.hold(folder / str(each), print):
                outcomes.put("entered")
                together.wait(60)
        except ValueError as error:
            outcomes.put(str(error))
            together.wait(60)


def test_of_many_that_come_at_once_one_enters(tmp_path):
    count, rounds = 8, 20
    together, outcomes = CONTEXT.Barrier(count), CONTEXT.Queue()
    processes = [CONTEXT.Process(target=enter, args=(tmp_path, rounds, together, outcomes)) for _ in range(count)]
    for process in processes:
        process.start()
    found = [outcomes.get(timeout=60) for _ in range(count * rounds)]
    for process in processes:
        process.join(60)
    assert found.count("entered") == rounds
    assert all("is in use by" in outcome for outcome in found if outcome != "entered")
    assert not [path for path in tmp_path.rglob("*") if path.is_file()], "no lock is left"


def stay(folder, inside):
    with lock.hold(folder, print):
        inside.set()
        inside.clear()
        multiprocessing.Event().wait(60)


@pytest.fixture
def occupied(tmp_path):
    """A run's directory, and a process that trains in it."""
    folder, inside = tmp_path / "run", CONTEXT.Event()
    process = CONTEXT.Process(target=stay, args=(folder, inside))
    process.start()
    while not (folder / lock.NAME).exists() or not (folder / lock.NAME).read_text():
        assert process.is_alive()
    yield folder, process
    process.kill()
    process.join()


@pytest.mark.parametrize("resume", [False, True])
def test_a_second_training_is_refused_and_one_after_a_kill_is_not(occupied, resume):
    folder, process = occupied
    config = tiny.config(folder, resume=resume)
    sentence = f"run is in use by process {process.pid} on {socket.gethostname()} since .*; wait for it or stop it, or"
    with pytest.raises(ValueError, match=sentence):
        runner.train_policy(config)
    assert [path.name for path in folder.iterdir()] == [lock.NAME]
    process.kill()
    process.join()
    assert (folder / lock.NAME).exists()
    runner.train_policy(config)
    assert not (folder / lock.NAME).exists()
    assert len((folder / "metrics.jsonl").read_text().splitlines()) == 1


def test_the_owner_on_another_host_is_named(occupied):
    folder, _ = occupied
    (folder / lock.NAME).write_text(json.dumps({"pid": 5, "host": "elsewhere", "since": "noon"}))
    with pytest.raises(ValueError, match="by process 5 on elsewhere since noon .if that host is down for good, remove"):
        lock.hold(folder, print).__enter__()
    (folder / lock.NAME).write_text("[")
    with pytest.raises(ValueError, match="in use by another process;"):
        lock.hold(folder, print).__enter__()


def test_without_locks_a_run_goes_on_with_a_warning(tmp_path, monkeypatch):
    def no_locks(*_):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    said = []
    monkeypatch.setattr(fcntl, "flock", no_locks)
    with lock.hold(tmp_path / "run", said.append):
        assert said == [
            f"The file system of {tmp_path / 'run'} has no locks: see to it that no other training runs there."
        ]


def test_a_refused_run_leaves_no_directory(tmp_path):
    with pytest.raises(ValueError, match=r"missing\.npz"):
        runner.train_policy(tiny.config(tmp_path / "runs" / "run", reference="missing.npz"))
    assert not list(tmp_path.iterdir())


def test_a_directory_that_cannot_be_made_is_refused_in_one_sentence(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match=r"^The run directory .*file cannot be written \(File exists\).$"):
        runner.train_policy(tiny.config(tmp_path / "file"))


def test_of_several_processes_the_first_locks_for_all(tmp_path, monkeypatch):
    monkeypatch.setattr("cassie_mjx.training.devices.is_first", lambda: False)
    monkeypatch.setattr("cassie_mjx.training.devices.exchange", lambda value: [0, value])
    with lock.hold(tmp_path / "run", print):
        assert not (tmp_path / "run").exists()
    monkeypatch.setattr("cassie_mjx.training.devices.exchange", lambda value: [1, value])
    with pytest.raises(ValueError, match="The first process was refused"):
        lock.hold(tmp_path / "run", print).__enter__()
