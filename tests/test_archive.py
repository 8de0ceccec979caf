"""Archives with a digest: what was written or nothing, whoever damaged or forged them."""

import io
import json
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cassie_mjx.agents.shipped import shipped_policies
from cassie_mjx.files import archive, atomic
from cassie_mjx.motion.files import shipped_path

KIND = "a small file"
ARRAYS = {"a": np.arange(3.0), "b": np.float32(2), "c": np.array(["x", "yz"]), "d": np.zeros((0, 35)), "e": True}


@pytest.fixture
def path(tmp_path):
    archive.write(tmp_path / "a.npz", KIND, ARRAYS, {"seed": 3})
    return tmp_path / "a.npz"


def same(found):
    assert found.provenance == {"seed": 3}
    assert found.arrays.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        assert found.arrays[name].dtype == np.asarray(array).dtype
        np.testing.assert_array_equal(found.arrays[name], array)


def without_digest(path):
    with np.load(path) as content:
        arrays: dict[str, Any] = dict(content) | {"version": 1}
    np.savez(path, **arrays)


def test_what_is_written_is_read_here_and_by_numpy(path):
    same(archive.read(path, KIND))
    assert archive.read(path, KIND).has_digest
    with np.load(path) as content:
        assert content["version"] == archive.VERSION
        np.testing.assert_array_equal(content["a"], ARRAYS["a"])
    without_digest(path)
    same(archive.read(path, KIND))
    assert not archive.read(path, KIND).has_digest


def test_the_same_content_gives_the_same_bytes(path):
    before = path.read_bytes()
    archive.write(path, KIND, ARRAYS, {"seed": 3})
    assert path.read_bytes() == before


def outcome(path, content):
    """Whether the file is read as it was written, or refused."""
    path.write_bytes(content)
    try:
        same(archive.read(path, KIND))
    except ValueError:
        return "refused"
    return "same"


def flipped(content, k, bit):
    return content[:k] + bytes([content[k] ^ 1 << bit]) + content[k + 1 :]


def test_no_bit_can_be_flipped_and_no_byte_be_missing_doubled_or_swapped(path):
    content = path.read_bytes()
    # The end is the zip archive's own end, and the digest: all of its bits.
    end = range(len(content) - 104, len(content))
    damaged = [flipped(content, k, bit) for k in end for bit in range(8)]
    damaged += [flipped(content, k, k % 8) for k in range(0, len(content), 3)]
    damaged += [content[:k] for k in (*range(0, len(content), 19), *end)]
    for k in range(0, len(content) - 1, 13):
        damaged += [content[:k] + content[k + 1 :], content[:k] + content[k : k + 1] + content[k:]]
        damaged += [content[:k] + content[k : k + 2][::-1] + content[k + 2 :]]
    assert {outcome(path, each) for each in damaged if each != content} == {"refused"}


def test_a_bit_flipped_without_a_digest_is_noticed_or_changes_nothing(path):
    without_digest(path)
    content = path.read_bytes()
    found = [outcome(path, flipped(content, k, k % 8)) for k in range(0, len(content), 3)]
    assert found.count("refused") > 0.8 * len(found)


def npy(header, data=b"", version=b"\1\0"):
    text = header.encode() + b"\n"
    return b"\x93NUMPY" + version + struct.pack("<H", len(text)) + text + data


def head(dtype="'<f8'", shape="(1,)", fortran="False"):
    return f"{{'descr': {dtype}, 'fortran_order': {fortran}, 'shape': {shape}, }}"


def forged(path, members, compression=zipfile.ZIP_STORED):
    """An archive of these files, with a digest, for anybody can make one."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", compression) as file:
        for name, data in members:
            file.writestr(name, data)
    path.write_bytes(archive._with_digest(content.getvalue()))


@pytest.mark.parametrize(
    "data",
    [
        npy(head(shape="(1000000000000000,)"), bytes(8)),
        npy(head(shape="(0, 100000000000000000000000)")),
        npy(head(shape=f"({'1, ' * 60})"), bytes(8)),
        npy(head(shape="(2,)"), bytes(8)),
        npy(head(shape="(1,)"), bytes(16)),
        npy(head(shape="(-1,)"), bytes(8)),
        npy(head(shape="(01,)"), bytes(8)),
        npy(head(shape="(1)"), bytes(8)),
        npy(head(shape="1"), bytes(8)),
        npy(head(dtype="'|O'"), bytes(8)),
        npy(head(dtype="'<f3'"), bytes(3)),
        npy(head(dtype="'<U0'")),
        npy(head(dtype="[('a', '<f8')]"), bytes(8)),
        npy(head(fortran="Maybe"), bytes(8)),
        npy(head()[:-1], bytes(8)),
        npy(9000 * "(" + ")", bytes(8)),
        npy("'''", bytes(8)),
        npy("\\", bytes(8)),
        npy("", bytes(8)),
        npy(head(), bytes(8), version=b"\3\0"),
        npy(head(), bytes(8), version=b"\x63\0"),
        b"\x93NUMPY\1\0\xff\xff" + head().encode() + b"\n" + bytes(8),
        b"not NumPy's",
        b"",
    ],
)
def test_an_array_whose_header_is_none_gets_one_sentence(path, data):
    forged(path, [("a.npy", data)])
    with pytest.raises(ValueError, match=r"a\.npz is damaged or no a small file: "):
        archive.read(path, KIND)


def test_what_numpy_would_unpack_without_end_is_refused_at_once(path, monkeypatch):
    forged(path, [("a.npy", npy(head(shape="(1000000,)"), bytes(8_000_000)))], zipfile.ZIP_DEFLATED)
    assert path.stat().st_size < 20_000
    with pytest.raises(ValueError, match="damaged, or compressed"):
        archive.read(path, KIND)
    forged(path, [(f"{k}.npy", b"") for k in range(1001)])
    with pytest.raises(ValueError, match=r"does not end as an \.npz file does"):
        archive.read(path, KIND)
    with pytest.warns(UserWarning, match="Duplicate name"):
        forged(path, [("a.npy", npy(head(), bytes(8)))] * 2)
    with pytest.raises(ValueError, match="holds 'a' twice"):
        archive.read(path, KIND)
    forged(path, [("../a", b"")])
    with pytest.raises(ValueError, match="has another name, too, or is no array"):
        archive.read(path, KIND)
    monkeypatch.setattr(archive, "LARGEST", 100)
    with pytest.raises(ValueError, match="bytes, more than 100"):
        archive.read(path, KIND)
    with pytest.raises(ValueError, match="no more than 100 are read back"):
        archive.write(path, KIND, ARRAYS, {})


def test_a_text_of_no_characters_gets_one_sentence(path):
    text = npy(head(dtype="'<U2'", shape="()"), b"\xff" * 8)
    forged(path, [("format.npy", text), ("version.npy", text)])
    with pytest.raises(ValueError, match="it is no array of numbers or texts|format holds what are no characters"):
        archive.read(path, KIND)


def test_all_files_of_ours_have_their_digest():
    for path, kind in [(path, "cassie-mjx policy") for path in shipped_policies().values()] + [
        (shipped_path("walk"), "cassie-mjx reference motion")
    ]:
        assert archive.read(path, kind).has_digest


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt(), SystemExit(143)])
def test_a_file_is_written_whole_or_not_at_all(tmp_path, error):
    path = tmp_path / "a.json"
    atomic.write_text(path, "old")
    with pytest.raises((OSError, KeyboardInterrupt, SystemExit)) as raised, atomic.replacing(path) as partial:  # noqa: PT012
        partial.write_text("ne")
        raise error
    assert (names(tmp_path), path.read_text()) == (["a.json"], "old")
    if isinstance(error, OSError):
        expected = f"{path} could not be written (No space left on device); nothing was replaced."
        assert str(raised.value) == expected


def test_where_nothing_can_be_written_the_file_is_named():
    with pytest.raises(OSError, match=r"^/proc/a\.json could not be written \(.*\); nothing was replaced\.$"):
        atomic.write_text(Path("/proc/a.json"), "x")
    with pytest.raises(OSError, match="proc"):
        atomic.check_writable(Path("/proc/a.json"))


def test_two_writers_of_one_file_do_not_meet(tmp_path):
    path = tmp_path / "a.json"
    with atomic.replacing(path) as one:
        with atomic.replacing(path) as other:
            one.write_text("one")
            other.write_text(json.dumps("other"))
        assert path.read_text() == '"other"'
    assert (names(tmp_path), path.read_text()) == (["a.json"], "one")


def test_a_written_file_has_the_rights_of_any_new_file(tmp_path):
    (tmp_path / "plain").write_text("")
    atomic.write_text(tmp_path / "a.json", "x")
    assert (tmp_path / "a.json").stat().st_mode == (tmp_path / "plain").stat().st_mode
