"""`key=value` command lines as frozen dataclasses: one way to read, explain and run every command."""

import difflib
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, TypeVar, get_origin

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from cassie_mjx.cli.explain import explain
from cassie_mjx.cli.sweep import sweep

C = TypeVar("C")


class Group(NamedTuple):
    """Presets of a key whose value is a dataclass itself: `ppo=paper`, and then `ppo.gamma=0.98` on top."""

    default: str
    presets: Mapping[str, Any]


def parse(
    config_class: type[C],
    arguments: Sequence[str],
    groups: Mapping[str, Group] | None = None,
    renamed: Mapping[str, str] | None = None,
) -> C:
    """Read `key=value` arguments into the frozen dataclass `config_class`; a tuple is `key=1,2` or `key=[1,2]`.

    Args:
      config_class: its fields are the keys; those of a field that is a dataclass have its name and a dot in front.
      arguments: of the command line.
      groups: keys that have presets.
      renamed: old to new names of keys; an old one that ends in a dot stands for all keys that begin with it.

    Raises:
      ValueError: an argument that is not `key=value`, an unknown key or preset, or a value that is no YAML or of the
        wrong type; the message says which ones there are.
    """
    groups = groups or {}
    settings = [_split(argument, renamed or {}, _keys(OmegaConf.structured(config_class))) for argument in arguments]
    chosen = {key: group.default for key, group in groups.items()} | {
        key: value for key, value in settings if key in groups
    }
    base: Any = OmegaConf.structured(config_class)
    _unfreeze(base)
    for key, group in groups.items():
        if chosen[key] not in group.presets:
            raise ValueError(f"{key}={chosen[key]} is not known; choose one of {', '.join(group.presets)}.")
        base[key] = OmegaConf.structured(group.presets[chosen[key]])
        _unfreeze(base[key])
    own = [(key, value) for key, value in settings if key not in groups]
    for key, value in own:
        _check_key(base, key)
        try:
            base = OmegaConf.merge(base, _read(key, value, _is_tuple(config_class, key)))
        except OmegaConfBaseException as error:
            raise ValueError(f"{key}={value}: {str(error).splitlines()[0]}.") from error
    try:
        return _with_tuples(OmegaConf.to_object(base))
    except OmegaConfBaseException as error:
        raise ValueError(_sentence(error)) from error


def run(
    main: Callable[[C], None],
    config_class: type[C],
    groups: Mapping[str, Group] | None = None,
    renamed: Mapping[str, str] | None = None,
) -> None:
    """Run a command: read `sys.argv`, call `main`; `--help` explains every key, `-m` runs all combinations of values.

    A ValueError or OSError ends it with one sentence and status 2, Ctrl-C with one word and status 130.
    """
    arguments = sys.argv[1:]
    if "--help" in arguments or "-h" in arguments:
        print(explain(sys.modules[main.__module__].__doc__ or "", config_class, groups or {}))
        return
    keep_compiled_programs()
    try:
        if "-m" in arguments or "--multirun" in arguments:
            sweep(
                [each for each in arguments if each not in ("-m", "--multirun")],
                _job(main, config_class, groups, renamed),
            )
        else:
            main(parse(config_class, arguments, groups, renamed))
    except (ValueError, OSError) as error:
        _refuse(error)
    except KeyboardInterrupt:
        print("Interrupted.", file=sys.stderr)
        sys.exit(128 + signal.SIGINT)


def _job(
    main: Callable[[C], None],
    config_class: type[C],
    groups: Mapping[str, Group] | None,
    renamed: Mapping[str, str] | None,
) -> Callable[[list[str]], None]:
    """One combination of a sweep, from its arguments."""

    def job(arguments: list[str]) -> None:
        # Here, for a launcher may have taken the job to another process; and Hydra would print a traceback.
        keep_compiled_programs()
        try:
            main(parse(config_class, arguments, groups, renamed))
        except (ValueError, OSError) as error:
            _refuse(error)

    return job


def _refuse(error: Exception) -> NoReturn:
    print(f"error: {error}", file=sys.stderr)
    sys.exit(2)


def keep_compiled_programs() -> None:
    """Keep what XLA compiles, if JAX is in use, in a folder of the user's unless the environment names another one."""
    jax = sys.modules.get("jax")
    if jax and not jax.config.jax_compilation_cache_dir:
        jax.config.update("jax_compilation_cache_dir", str(Path.home() / ".cache" / "cassie-mjx"))


def _split(argument: str, renamed: Mapping[str, str], keys: Sequence[str]) -> tuple[str, str]:
    key, equals, value = argument.partition("=")
    if not equals:
        raise ValueError(f"{argument!r} is not of the form key=value; the keys are {', '.join(keys)}.")
    for old, new in renamed.items():
        if key == old or (old.endswith(".") and key.startswith(old)):
            now = new + key.removeprefix(old)
            print(f"{key} is now called {now}.", file=sys.stderr)
            return now, value
    return key, value


def _keys(node: DictConfig) -> list[str]:
    return [str(key) for key in node]


def _check_key(base: DictConfig, key: str) -> None:
    """Raise ValueError unless the dotted `key` is one of the configuration's."""
    node: Any = base
    for part in key.split("."):
        known = _keys(node) if isinstance(node, DictConfig) else []
        if part not in known:
            near = difflib.get_close_matches(part, known, 1)
            hint = f" Did you mean {near[0]}?" if near else ""
            raise ValueError(f"{key!r} is not a key; the keys are {', '.join(known or _keys(base))}.{hint}")
        node = node[part]


def _is_tuple(config_class: type, key: str) -> bool:
    first, _, rest = key.partition(".")
    kinds = {field.name: field.type for field in fields(config_class)}
    kind = kinds.get(first)
    if rest:
        return isinstance(kind, type) and is_dataclass(kind) and _is_tuple(kind, rest)
    return get_origin(kind) is tuple


def _read(key: str, value: str, is_tuple: bool) -> DictConfig:
    """One setting, its value read as YAML. Raise ValueError if that is not possible."""
    text = f"[{value}]" if is_tuple and not value.startswith("[") else value
    try:
        return OmegaConf.from_dotlist([f"{key}={text}"])
    except yaml.YAMLError as error:
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise ValueError(
            f"{f'{key}={value}'!r} has a value that is no YAML ({problem}); close its brackets, or put it in quotes "
            f"that the shell keeps, \"{key}='...'\"."
        ) from error


def _with_tuples(config: Any) -> Any:
    """The configuration with tuples where OmegaConf has lists."""
    for field in fields(config):
        value = getattr(config, field.name)
        if isinstance(value, list):
            object.__setattr__(config, field.name, tuple(value))
        elif is_dataclass(value):
            _with_tuples(value)
    return config


def _unfreeze(node: DictConfig) -> None:
    """Let settings be merged into the schema of a frozen dataclass; `OmegaConf.to_object` freezes the result."""
    OmegaConf.set_readonly(node, None)
    for key in node:
        if isinstance(value := node[key], DictConfig):
            _unfreeze(value)


def _sentence(error: OmegaConfBaseException) -> str:
    """What an error of OmegaConf's says, in one line: that of the configuration's own check, if that is its cause."""
    cause = error.__cause__ if isinstance(error.__cause__, ValueError) else None
    return str(cause) if cause else f"{error.full_key}: {str(error).splitlines()[0]}."
