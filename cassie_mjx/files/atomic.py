"""Files written whole or not at all."""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """An empty file beside `path` for the block to fill; it takes the place of `path` when the block ends.

    Its name is its own, so that two writers of one file do not meet. Whatever the block raises, KeyboardInterrupt
    included, it is removed, and `path` is as it was.

    Raises:
      OSError: it cannot be written; the sentence names `path`.
    """
    try:
        with _partial(path) as partial:
            yield partial
            sync(partial)
            partial.replace(path)
    except OSError as error:
        raise OSError(f"{path} could not be written ({error.strerror or error}); nothing was replaced.") from error


def write_bytes(path: Path, content: bytes) -> None:
    """Write `content` to `path` whole or not at all. Raises OSError that names `path`."""
    with replacing(path) as partial:
        partial.write_bytes(content)


def write_text(path: Path, text: str) -> None:
    """Write `text` to `path` in UTF-8, whole or not at all. Raises OSError that names `path`."""
    write_bytes(path, text.encode())


def check_writable(path: Path) -> None:
    """Raise OSError if no file can be written beside `path`: one is made there, and removed."""
    with _partial(path):
        pass


@contextmanager
def _partial(path: Path) -> Iterator[Path]:
    """An empty file beside `path` that is gone when the block ends."""
    partial = path.with_name(f"{path.name}.{secrets.token_hex(4)}.partial")
    try:
        os.close(os.open(partial, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        yield partial
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


def sync(path: Path) -> None:
    """Wait until a file or folder is on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
