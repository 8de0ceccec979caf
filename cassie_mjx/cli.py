"""`key=value` command lines as frozen dataclasses, and the record of where a result came from."""

import datetime
import importlib.metadata
import json
import os
import platform
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Container, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, TypeVar, get_origin

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

PACKAGES = ("mujoco", "mujoco-mjx", "jax", "jaxlib", "brax", "flax", "optax", "numpy")

C = TypeVar("C")


def parse(config_class: type[C], arguments: Sequence[str]) -> C:
    """Read `key=value` arguments into the frozen dataclass `config_class`; a tuple is `key=1,2` or `key=[1,2]`.

    Raises:
      ValueError: an argument that is not `key=value`, an unknown key, or a value that is no YAML or of the wrong type.
    """
    valid = ", ".join(field.name for field in fields(config_class))  # type: ignore[arg-type]
    for argument in arguments:
        key, equals, _ = argument.partition("=")
        if not equals:
            raise ValueError(f"{argument!r} is not of the form key=value; the keys are {valid}.")
        if key not in valid.split(", "):
            raise ValueError(f"{key!r} is not a key; the keys are {valid}.")
    tuples = {field.name for field in fields(config_class) if get_origin(field.type) is tuple}  # type: ignore[arg-type]
    try:
        merged = OmegaConf.merge(OmegaConf.structured(config_class), *(_read(each, tuples) for each in arguments))
        config: Any = OmegaConf.to_object(merged)
    except OmegaConfBaseException as error:
        raise ValueError(f"{' '.join(arguments)}: {str(error).splitlines()[0]}.") from error
    # OmegaConf reads a tuple as a list.
    sequences = {f.name: tuple(v) for f in fields(config) if isinstance(v := getattr(config, f.name), list)}
    return replace(config, **sequences)


def _read(argument: str, tuples: Container[str]) -> DictConfig:
    """One `key=value`, its value read as YAML. Raise ValueError if that is not possible."""
    key, _, _ = argument.partition("=")
    try:
        return OmegaConf.from_dotlist([_bracketed(argument) if key in tuples else argument])
    except yaml.YAMLError as error:
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise ValueError(
            f"{argument!r} has a value that is no YAML ({problem}); close its brackets, or put it in quotes that the "
            f"shell keeps, \"{key}='...'\"."
        ) from error


def _bracketed(argument: str) -> str:
    key, _, value = argument.partition("=")
    return argument if value.startswith("[") else f"{key}=[{value}]"


def run(main: Callable[[C], None], config_class: type[C]) -> None:
    """Run a command: parse `sys.argv`, call `main`.

    A ValueError or OSError ends it with one sentence and status 2, Ctrl-C with one word and status 130.
    """
    keep_compiled_programs()
    try:
        main(parse(config_class, sys.argv[1:]))
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("Interrupted.", file=sys.stderr)
        sys.exit(128 + signal.SIGINT)


def keep_compiled_programs() -> None:
    """Keep what XLA compiles, if JAX is in use, in a folder of the user's unless the environment names another one."""
    jax = sys.modules.get("jax")
    if jax and not jax.config.jax_compilation_cache_dir:
        jax.config.update("jax_compilation_cache_dir", str(Path.home() / ".cache" / "cassie-mjx"))


def check_writable(out: str) -> Path:
    """The file `out`, or the one that a link `out` leads to; for the door, before hours of work.

    Whatever takes the place of a file must take that of the returned one. The format is what the ending of `out` says:
    that of a link's target may be another.

    Raises:
      ValueError: no file can be written there, or what is there is no regular file, such as a pipe or a device.
    """
    path = Path(os.path.realpath(out)) if Path(out).is_symlink() else Path(out)
    if path.is_dir() or not path.parent.is_dir() or not os.access(path.parent, os.W_OK):
        raise ValueError(f"{out} cannot be written; name a file in an existing folder that you may write to.")
    if os.path.lexists(path) and not path.is_file():
        raise ValueError(f"{out} is not a regular file, and would be replaced by one; name another file.")
    return path


def provenance(**more: Any) -> dict[str, Any]:
    """Where a result comes from: command, commit, date, hardware, versions, and whatever else is given."""
    module = getattr(sys.modules["__main__"], "__spec__", None)
    name = module.name.removesuffix(".__main__") if module else Path(sys.argv[0]).name
    return {
        "command": " ".join(["python -m", name, *sys.argv[1:]]),
        "commit": _commit(),
        "date": datetime.date.today().isoformat(),
        "hardware": ", ".join([_processor(), f"{os.cpu_count()} cores", *_accelerators()]),
        "python": platform.python_version(),
        "versions": {name: importlib.metadata.version(name) for name in PACKAGES},
        **more,
    }


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write `content` to `path` whole or not at all."""
    write_text(path, json.dumps(content, indent=1) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write `text` to `path` whole or not at all."""
    partial = path.with_name(path.name + ".partial")
    partial.write_text(text)
    partial.replace(path)


def _commit() -> str:
    git = ["git", "-C", str(Path(__file__).parent)]
    try:
        top = subprocess.run([*git, "rev-parse", "--show-toplevel"], capture_output=True, text=True, check=True)
        if Path(top.stdout.strip()) != Path(__file__).parents[1]:
            return "not a checkout"
        commit = subprocess.run([*git, "rev-parse", "--short=12", "HEAD"], capture_output=True, text=True, check=True)
        changes = subprocess.run([*git, "status", "--porcelain", "-uno"], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
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
