"""`key=value` command lines as frozen dataclasses, and the record of where a result came from."""

import signal
import sys
from collections.abc import Callable, Container, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, TypeVar, get_origin

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

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
