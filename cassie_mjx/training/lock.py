"""One training at a time in a run's directory.

The lock is the operating system's, on the file `run.lock`: the kernel frees it when its process ends, however that
ends. On NFS the file server does so, also among hosts. What the file holds is for people: who has the lock, since when.
"""

import errno
import fcntl
import json
import os
import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from datetime import datetime
from pathlib import Path

from cassie_mjx.training import devices

NAME = "run.lock"

_HELD = (errno.EAGAIN, errno.EACCES)
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL)


@contextmanager
def hold(folder: Path, say: Callable[[str], None]) -> Iterator[None]:
    """Keep others out of a run's directory; the first process does so for all, and every process must call it.

    Args:
      folder: made if missing; in the end who made it removes it if nothing else came into it.
      say: is called if the file system has no locks.

    Raises:
      ValueError: another training holds it; the message says which.
      OSError: it cannot be written.
    """
    refusal: Exception | None = None
    with ExitStack() as stack:
        if devices.is_first():
            try:
                stack.enter_context(_locked(folder, say))
            except (OSError, ValueError) as error:
                refusal = error
        if any(devices.exchange(int(refusal is not None))):
            raise refusal or ValueError(f"The first process was refused {folder}.")
        yield


@contextmanager
def _locked(folder: Path, say: Callable[[str], None]) -> Iterator[None]:
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    path = folder / NAME
    try:
        descriptor = _take(path, say)
    except OSError as error:
        raise OSError(f"The run directory {folder} cannot be written ({error.strerror or error}).") from error
    try:
        yield
    finally:
        # While it is locked, so that nobody removes the file that another one has locked since.
        path.unlink(missing_ok=True)
        os.close(descriptor)
        with suppress(OSError):
            for each in made:
                each.rmdir()


def _take(path: Path, say: Callable[[str], None]) -> int:
    """Descriptor of the file, locked."""
    while True:
        path.parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):  # whoever had made the directory for itself has removed it
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
            try:
                _lock(descriptor, path, say)
                if _is_at(descriptor, path):
                    owner = {"pid": os.getpid(), "host": socket.gethostname(), "since": _now()}
                    os.ftruncate(descriptor, 0)
                    os.pwrite(descriptor, json.dumps(owner).encode(), 0)
                    return descriptor
            except BaseException:
                os.close(descriptor)
                raise
            os.close(descriptor)


def _lock(descriptor: int, path: Path, say: Callable[[str], None]) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in _HELD:
            raise ValueError(
                f"{path.parent} is in use by {_owner(descriptor, path)}; wait for it or stop it, or choose another "
                "run_dir."
            ) from error
        if error.errno not in _NO_LOCKS:
            raise
        say(f"The file system of {path.parent} has no locks: see to it that no other training runs there.")


def _is_at(descriptor: int, path: Path) -> bool:
    """Whether the locked file is still the one at `path`, not removed by the last owner."""
    with suppress(FileNotFoundError):
        return os.path.samestat(os.fstat(descriptor), path.stat())
    return False


def _owner(descriptor: int, path: Path) -> str:
    try:
        owner = json.loads(os.pread(descriptor, 1000, 0))
        pid, host, since = (str(owner[name]) for name in ("pid", "host", "since"))
    except (OSError, ValueError, KeyError, TypeError):
        return "another process"
    elsewhere = "" if host == socket.gethostname() else f" (if that host is down for good, remove {path})"
    return f"process {pid} on {host} since {since}{elsewhere}"


def _now() -> str:
    return datetime.now().astimezone().isoformat(sep=" ", timespec="seconds")
