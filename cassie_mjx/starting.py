"""What a command needs before its imports, which take seconds. Where this package is a library, nothing is changed."""

import os
import signal
import sys

INTERRUPTED = 128 + signal.SIGINT
"""Status of a command that Ctrl-C ended."""

# As the user set it, taken out of the environment: of a value that does not work here `import mujoco` fails, even where
# nothing is drawn. What draws asks for it (`robot.drawing`).
_mujoco_gl: list[str] = []


def begin(package: str) -> None:
    """Prepare the process if it is to run a module of the package that is being imported, or the console script."""
    # Until the package is there, the first argument is not yet the module's path.
    modules = [argument.removeprefix("-m") for argument in sys.orig_argv[1:]] if sys.argv[:1] == ["-m"] else []
    named = any(module.startswith(f"{package}.") for module in modules)
    if not named and os.path.basename(sys.argv[0]) not in ("cassie-mjx", "cassie-mjx.exe"):
        return
    # One that is ignored, as in a shell's background, stays so.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, end_at_once)
    if chosen := os.environ.pop("MUJOCO_GL", None):
        _mujoco_gl.append(chosen)


def end_at_once(*_: object) -> None:
    """End by Ctrl-C with one word: in the midst of imports, an exception would be a traceback or be lost."""
    os.write(2, b"Interrupted.\n")
    os._exit(INTERRUPTED)


def environment() -> dict[str, str]:
    """The environment as the user set it, for a process that this one starts."""
    chosen = mujoco_gl()
    return {**os.environ, **({"MUJOCO_GL": chosen} if chosen else {})}


def mujoco_gl() -> str | None:
    """What the user has MuJoCo draw with, if anything."""
    return _mujoco_gl[-1] if _mujoco_gl else os.environ.get("MUJOCO_GL")
