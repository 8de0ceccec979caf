"""Where a result comes from."""

import datetime
import importlib.metadata
import os
import platform
import shlex
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

PACKAGES = ("mujoco", "mujoco-mjx", "jax", "jaxlib", "brax", "flax", "optax", "numpy")


def provenance(**more: Any) -> dict[str, Any]:
    """Where a result comes from: command, commit, date, hardware, versions, and what is given under other names."""
    own = {
        "command": shlex.join([*program(_module()), *sys.argv[1:]]),
        "commit": _commit(),
        "date": datetime.date.today().isoformat(),
        "hardware": ", ".join([_processor(), f"{os.cpu_count()} cores", *_accelerators()]),
        "python": platform.python_version(),
        "versions": {name: version_of(name) for name in PACKAGES},
    }
    return own | more | own


def program(module: str) -> list[str]:
    """What a command line begins with that runs this module: `cassie-mjx COMMAND` if the present one does so, too."""
    console = sys.argv[0].startswith("cassie-mjx ")
    return sys.argv[0].split() if console else ["python", "-m", module]


def is_ours(command: str) -> bool:
    """Whether the present command, whatever its keys, wrote a file whose provenance has this `command`."""
    return _program(shlex.split(command)) == _program(program(_module()))


def _program(words: list[str]) -> list[str]:
    """What a command line runs, under either of its names."""
    return ["python", "-m", f"cassie_mjx.{words[1]}"] if words[:1] == ["cassie-mjx"] else words[:3]


def version_of(package: str) -> str:
    """The installed version of a package, or that it is not installed."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _module() -> str:
    """The module that the present command runs."""
    path = Path(sys.argv[0])
    # By its file, for a launcher of Hydra's may have taken the job to a process that runs another module.
    if path.parent.name in ("cassie_mjx", "experiments"):
        return f"{path.parent.name}.{path.stem}"
    module = getattr(sys.modules["__main__"], "__spec__", None)
    return module.name.removesuffix(".__main__") if module else path.name


def _commit() -> str:
    git = ["git", "-C", str(Path(__file__).parent)]
    try:
        top = subprocess.run([*git, "rev-parse", "--show-toplevel"], capture_output=True, text=True, check=True)
        if Path(top.stdout.strip()) != Path(__file__).parents[2]:
            return "not a checkout"
        commit = subprocess.run([*git, "rev-parse", "--short=12", "HEAD"], capture_output=True, text=True, check=True)
        changes = subprocess.run([*git, "status", "--porcelain", "-uno"], capture_output=True, text=True, check=True)
    except (OSError, ValueError, subprocess.CalledProcessError):
        return "not a checkout"
    return commit.stdout.strip() + ("+changes" if changes.stdout.strip() else "")


def _accelerators() -> list[str]:
    """What JAX computes on other than the processor, if JAX is in use."""
    jax = sys.modules.get("jax")
    if not jax or jax.default_backend() == "cpu":
        return []
    counts = Counter(device.device_kind for device in jax.devices())
    return [f"{count} x {kind}" for kind, count in counts.items()]


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.machine())
