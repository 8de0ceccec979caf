"""Damaged checkpoints: each is refused in a sentence that names the file, and gives way to the one before it."""

import errno
import json
import shutil

import numpy as np
import pytest

from cassie_mjx.motion.files import load_motion
from cassie_mjx.training import checkpoint, manifest
from cassie_mjx.training.counters import from_record

MOTION = load_motion("walk")
STATE = {"x": np.arange(1000.0), "y": (np.ones(3), np.zeros((4, 4)))}


def last(directory):
    return checkpoint.latest(directory) or pytest.fail("no checkpoint")


def files(directory):
    return sorted(path for path in directory.rglob("*") if path.is_file() and not path.name.startswith("manifest."))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return checkpoint.save(tmp_path_factory.mktemp("whole"), 1, STATE, MOTION, {})


def damaged(whole, tmp_path, name):
    copy = tmp_path / whole.name
    shutil.copytree(whole, copy)
    return copy, copy / name


def test_any_flipped_bit_is_refused_by_the_files_name(whole, tmp_path):
    for i, original in enumerate(files(whole)):
        copy, victim = damaged(whole, tmp_path / str(i), original.relative_to(whole))
        content = bytearray(victim.read_bytes())
        if not content:
            continue
        content[len(content) // 2] ^= 1
        victim.write_bytes(content)
        with pytest.raises(ValueError, match=f"{victim.name} is not what was saved: its SHA-256 differs"):
            checkpoint.restore(copy)


def test_a_truncated_or_missing_file_is_refused_by_its_name(whole, tmp_path):
    largest = max(files(whole), key=lambda path: path.stat().st_size).relative_to(whole)
    copy, victim = damaged(whole, tmp_path, largest)
    content = victim.read_bytes()
    victim.write_bytes(content[:-1])
    with pytest.raises(ValueError, match=f"{victim.name} has {len(content) - 1} bytes instead of {len(content)}"):
        checkpoint.restore(copy)
    victim.unlink()
    with pytest.raises(ValueError, match=f"{victim.name} is missing"):
        checkpoint.restore(copy)


def rewritten(path, change):
    """The manifest's entries as `change` leaves them."""
    entries = json.loads(path.read_text())
    change(entries)
    return json.dumps(entries)


MANIFESTS = {
    "empty": lambda path: "{}",
    "cut short": lambda path: path.read_text()[:-5],
    "no object": lambda path: "[1]",
    "too deep": lambda path: "[" * 100_000,
    "a key flipped": lambda path: path.read_text().replace("sha256", "sha257", 1),
    "no entries": lambda path: rewritten(path, lambda entries: entries.update({"record.json": 5})),
    "a name flipped": lambda path: path.read_text().replace("record.json", "recorc.json"),
}


@pytest.mark.parametrize("damage", MANIFESTS)
def test_a_damaged_manifest_is_refused_by_its_name(whole, tmp_path, damage):
    copy, path = damaged(whole, tmp_path, "manifest.json")
    path.write_text(MANIFESTS[damage](path))
    with pytest.raises(ValueError, match=r"manifest.json or manifest.sha256 is not what was saved: the SHA-256"):
        checkpoint.restore(copy)
    # One from before manifests had a digest.
    (copy / "manifest.sha256").unlink()
    with pytest.raises(ValueError, match=f"{copy.name} is damaged.$"):
        checkpoint.restore(copy)


def test_a_damaged_digest_of_the_manifest_is_refused(whole, tmp_path):
    copy, digest = damaged(whole, tmp_path, "manifest.sha256")
    for content in (b"", b"\xff", digest.read_bytes().replace(b"manifest.json", b"manifest.jsom")):
        digest.write_bytes(content)
        with pytest.raises(ValueError, match="manifest.json or manifest.sha256 is not what was saved"):
            checkpoint.restore(copy)


def test_a_file_that_was_not_saved_is_refused(whole, tmp_path):
    copy, added = damaged(whole, tmp_path, "state/added")
    added.write_text("")
    with pytest.raises(ValueError, match="state/added is not in the manifest; step_000001 is damaged"):
        checkpoint.restore(copy)


def test_a_checkpoint_from_before_manifests_had_a_digest_restores(whole, tmp_path):
    copy, digest = damaged(whole, tmp_path, "manifest.sha256")
    digest.unlink()
    assert np.array_equal(checkpoint.restore(copy).arrays["['x']"], STATE["x"])


def rerecorded(checkpoint_folder, content):
    (checkpoint_folder / "record.json").write_text(content)
    manifest.write(checkpoint_folder)


def unreadable(monkeypatch, path):
    opened = type(path).open

    def refuse(self, *args, **kwargs):
        if path in (self, *self.parents):
            raise PermissionError(errno.EACCES, "Permission denied", str(self))
        return opened(self, *args, **kwargs)

    monkeypatch.setattr(type(path), "open", refuse)


DAMAGES = {
    "an unreadable file": lambda last, patch: unreadable(patch, last / "reference.npz"),
    "an unreadable manifest": lambda last, patch: unreadable(patch, last / "manifest.json"),
    "an empty directory": lambda last, patch: [shutil.rmtree(last), last.mkdir()],
    "a file": lambda last, patch: [shutil.rmtree(last), last.write_text("")],
    "a record that is no object": lambda last, patch: rerecorded(last, "[]"),
    "a record too deep": lambda last, patch: rerecorded(last, "[" * 100_000),
    "a record without a format": lambda last, patch: rerecorded(last, "{}"),
    "a record without counters": lambda last, patch: rerecorded(last, '{"format": 1}'),
    "counters of another type": lambda last, patch: rerecorded(last, '{"format": 1, "counters": [1]}'),
    "a counter of another type": lambda last, patch: rerecorded(last, '{"format": 1, "counters": {"train_s": null}}'),
    "an unknown counter": lambda last, patch: rerecorded(last, '{"format": 1, "counters": {"song": 1}}'),
    "ends that are no counts": lambda last, patch: rerecorded(
        last, '{"format": 1, "counters": {}, "interval": {"ends": {"nan": Infinity}}}'
    ),
    "no state": lambda last, patch: [shutil.rmtree(last / "state"), manifest.write(last)],
    "a state that is none": lambda last, patch: [(last / "state" / "_METADATA").write_text("{"), manifest.write(last)],
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_whatever_is_damaged_the_checkpoint_before_it_is_restored(tmp_path, monkeypatch, damage):
    record = {"counters": {"train_s": 1.0}}
    for number in (1, 2):
        checkpoint.save(tmp_path, number, {"x": np.full(2, number)}, MOTION, record)
    DAMAGES[damage](tmp_path / "step_000002", monkeypatch)
    restored, (sentence,) = checkpoint.restore_last(tmp_path, from_record)
    assert restored is not None
    assert restored.iteration == 1
    assert "step_000002" in sentence
    assert "\n" not in sentence
    monkeypatch.undo()
    # And the run can go on to save.
    checkpoint.save(tmp_path, 2, {"x": np.full(2, 2)}, MOTION, record)
    assert checkpoint.restore(last(tmp_path)).iteration == 2


def test_other_names_are_no_checkpoints(tmp_path):
    for name in ("step_²", "step_", "step_000001.partial", "step_-1"):
        (tmp_path / name).mkdir()
    assert checkpoint.latest(tmp_path) is None
