"""How a command ends: done, with one sentence and status 2, or by Ctrl-C with one word and status 130."""

import _thread
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from cassie_mjx.cli.process import as_command
from cassie_mjx.starting import INTERRUPTED, end_at_once

if TYPE_CHECKING:
    from sys import UnraisableHookArgs


@contextmanager
def one_sentence() -> Iterator[None]:
    """Run a command: a ValueError or OSError ends it with its sentence, Ctrl-C with one word."""
    before, sys.unraisablehook = sys.unraisablehook, _unraisable
    try:
        if signal.getsignal(signal.SIGINT) is end_at_once:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        with as_command():
            yield
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("Interrupted.", file=sys.stderr)
        sys.exit(INTERRUPTED)
    finally:
        sys.unraisablehook = before


def _unraisable(unraisable: "UnraisableHookArgs") -> None:
    """Interrupt once more if Ctrl-C came in a callback or destructor, as JAX has, where Python loses exceptions."""
    if unraisable.exc_type is KeyboardInterrupt:
        threading.Timer(0.1, _thread.interrupt_main).start()
    else:
        sys.__unraisablehook__(unraisable)


@contextmanager
def plain_words() -> Iterator[None]:
    """Raise a ValueError in one sentence in place of what the machine's memory or the environment is to blame for."""
    try:
        yield
    except (ValueError, OSError):
        raise
    except Exception as error:
        if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
            first = (str(error) or "no more is free").splitlines()[0]
            raise ValueError(f"The memory is not enough: {first.rstrip('.')}. Ask for less at a time.") from error
        if sentence := _no_device():
            raise ValueError(sentence) from error
        raise


def _no_device() -> str:
    """A sentence about the devices that JAX is to use, and does not find; empty if it finds them."""
    jax, wanted = sys.modules.get("jax"), os.environ.get("JAX_PLATFORMS")
    if not jax or not wanted:
        return ""
    try:
        jax.devices()
    except (RuntimeError, AssertionError):
        return f"JAX_PLATFORMS={wanted} names no device that JAX finds here; JAX_PLATFORMS=cpu works, or unset it."
    return ""
