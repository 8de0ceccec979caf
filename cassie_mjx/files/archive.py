"""Archives of arrays with their SHA-256: plain .npz files that `numpy.load` reads, and that are checked when read here.

The digest ends the file, as the comment of the zip archive, and covers every byte before it. It is checked before
anything is parsed. Files of version 1 have none; what is damaged in a file of version 2 never makes it one of version
1, whose parts are held to be exactly as `numpy.savez` lays them out.
"""

import hashlib
import io
import json
import math
import re
import struct
import sys
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cassie_mjx.files.atomic import write_bytes

VERSION = 2
"""Of files with a digest; those of version 1 have none."""

LARGEST = 2**28
"""Bytes of a file that is read; more is none of ours."""
_MOST_MEMBERS = 1000

_MARK = b"cassie-mjx sha256 "
_HEX = 64

# Of a zip archive, as its specification (APPNOTE.TXT) has them: a member's header, its entry in the directory, the end.
_LOCAL = struct.Struct("<4s5H3L2H")
_ENTRY = struct.Struct("<4s6H3L5H2L")
_END = struct.Struct("<4s4H2LH")

# The header that NumPy writes before an array. Nothing in it is evaluated.
_ARRAY = re.compile(
    rb"\x93NUMPY\x01\x00(?P<length>..)\{'descr': '(?P<dtype>\|b1|[|<>][iu]1|[<>][iuf][248]|[<>]U[1-9][0-9]{0,6})', "
    rb"'fortran_order': (?P<fortran>True|False), 'shape': \((?P<shape>[0-9, ]{0,200})\), \} *\n",
    re.DOTALL,
)


class Archive(NamedTuple):
    """What a file holds."""

    arrays: dict[str, np.ndarray]
    """All but what stands beside them here, by name."""
    provenance: dict[str, Any]
    """Where it came from."""
    has_digest: bool
    """Whether the whole file is known to be as it was written; a file of version 1 is not."""


def write(path: Path, kind: str, arrays: Mapping[str, Any], provenance: Mapping[str, Any]) -> None:
    """Write an archive of a kind of file, whole or not at all, with its digest.

    Raises:
      OSError: it cannot be written; a file of that name is as it was.
      ValueError: it would be too large to be read back, or `provenance` is nothing that JSON can hold.
    """
    content = io.BytesIO()
    origin = {"format": kind, "version": VERSION, "provenance": json.dumps(dict(provenance))}
    np.savez(content, **arrays, **origin)  # type: ignore[arg-type]
    if content.tell() > LARGEST:
        raise ValueError(f"{path} would have {content.tell()} bytes; no more than {LARGEST} are read back.")
    write_bytes(path, _with_digest(content.getvalue()))


def read(path: Path, kind: str) -> Archive:
    """Read an archive of a kind of file.

    Raises:
      ValueError: there is no such file, it is damaged, or it is of another kind or version.
    """
    if not path.is_file():
        raise ValueError(f"There is no {kind.removeprefix('cassie-mjx ')} file {path}.")
    try:
        content, has_digest = _checked(path)
        arrays = {name: _array(name, data) for name, data in _members(content).items()}
        found, version = (str(arrays.pop(name, None)) for name in ("format", "version"))
    except (OSError, ValueError, OverflowError, struct.error) as error:
        raise ValueError(f"{path} is damaged or no {kind}: {error}.") from error
    if found != kind:
        raise ValueError(f"{path} is not a {kind}.")
    if version not in ("1", str(VERSION)):
        raise ValueError(f"{path} has version {version}; this program reads versions 1 and {VERSION}.")
    if has_digest != (version == str(VERSION)):
        raise ValueError(f"{path} is damaged: files of version {VERSION}, and no others, end with their SHA-256.")
    return Archive(arrays, _provenance(path, arrays.pop("provenance", None)), has_digest)


def is_kind(path: Path, kind: str) -> bool:
    """Whether a file is a whole archive of that kind."""
    try:
        read(path, kind)
    except ValueError:
        return False
    return True


def _with_digest(content: bytes) -> bytes:
    """A zip archive without a comment, with its digest as its comment."""
    # The length of the comment is the last that an archive says of itself.
    covered = content[:-2] + struct.pack("<H", len(_MARK) + _HEX) + _MARK
    return covered + hashlib.sha256(covered).hexdigest().encode()


def _checked(path: Path) -> tuple[bytes, bool]:
    """A file's zip archive without its comment, and whether a digest vouches for it."""
    if (size := path.stat().st_size) > LARGEST:
        raise ValueError(f"it has {size} bytes, more than {LARGEST}")
    content = path.read_bytes()
    covered, digest = content[:-_HEX], content[-_HEX:]
    if not covered.endswith(_MARK):
        return content, False
    if hashlib.sha256(covered).hexdigest().encode() != digest:
        raise ValueError("its SHA-256 is not the one that it was written with")
    return covered[: -len(_MARK) - 2] + bytes(2), True


def _members(archive: bytes) -> dict[str, memoryview]:
    """The content of each file in a zip archive that is laid out as `numpy.savez` does it.

    They stand one after another, not compressed, from the first byte on; then comes the list of them, then the end. So
    an archive holds no more than it has bytes.
    """
    end = len(archive) - _END.size
    signature, *disks, listed, count, size, at, comment = _END.unpack_from(archive, end)
    if (signature, disks, listed, comment, at + size) != (b"PK\5\6", [0, 0], count, 0, end) or count > _MOST_MEMBERS:
        raise ValueError("it does not end as an .npz file does")
    members, start, listing = {}, 0, at
    for _ in range(count):
        name, data, start, at = _member(archive, start, at)
        if name in members:
            raise ValueError(f"it holds {name!r} twice")
        members[name] = data
    if (start, at) != (listing, end):
        raise ValueError("there is more in it than its list says")
    return members


def _member(archive: bytes, start: int, at: int) -> tuple[str, memoryview, int, int]:
    """A file in an archive whose header is at `start` and whose entry in the list is at `at`.

    Returns:
      Its name, its content, and where the next one's header and entry are.
    """
    entry, _, _, *same, crc, packed, size, letters, extra, comment, _, _, _, offset = _ENTRY.unpack_from(archive, at)
    header, _, *as_listed, _, _, again, more = _LOCAL.unpack_from(archive, start)
    begin = start + _LOCAL.size + again + more
    name, data = archive[at + _ENTRY.size :][:letters], memoryview(archive)[begin : begin + size]
    stored = (entry, header, same[:2], packed, offset) == (b"PK\1\2", b"PK\3\4", [0, 0], size, start)
    if not stored or extra or comment or [*same, crc] != as_listed or zlib.crc32(data) != crc:
        raise ValueError(f"{name!r} in it is damaged, or compressed")
    if archive[start + _LOCAL.size :][:again] != name or not name.endswith(b".npy") or not name.isascii():
        raise ValueError(f"{name!r} in it has another name, too, or is no array")
    return name.decode().removesuffix(".npy"), data, begin + size, at + _ENTRY.size + letters


def _array(name: str, data: memoryview) -> np.ndarray:
    """An array from what `numpy.save` writes. Raise ValueError unless its header fits its size to the byte."""
    header = _ARRAY.match(data)
    if header is None or struct.unpack("<H", header["length"])[0] != header.end() - 10:
        raise ValueError(f"{name} is no array of numbers or texts")
    shape = tuple(int(length) for length in re.findall(rb"[0-9]+", header["shape"]))
    dtype = np.dtype(header["dtype"].decode())
    if str(shape)[1:-1] != header["shape"].decode() or math.prod(shape) * dtype.itemsize != len(data) - header.end():
        raise ValueError(f"{name} does not have the size that its header says")
    if dtype.kind == "U" and (np.frombuffer(data[header.end() :], dtype.byteorder + "u4") > sys.maxunicode).any():
        raise ValueError(f"{name} holds what are no characters")
    order = "F" if header["fortran"] == b"True" else "C"
    return np.ndarray(shape, dtype, data, header.end(), order=order).copy()


def _provenance(path: Path, text: np.ndarray | None) -> dict[str, Any]:
    """What JSON says of where a file came from."""
    try:
        found = json.loads(str(text))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is damaged: its provenance is no JSON ({error}).") from error
    if not isinstance(found, dict):
        raise ValueError(f"{path} is damaged: its provenance has no names.")
    return found
