"""`key=value` command lines as frozen dataclasses: one way to read, explain and run every command."""

import os
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, make_dataclass
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

import yaml
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from cassie_mjx.cli.explain import explain
from cassie_mjx.cli.keys import Group, Key, build, check_choice, did_you_mean, flatten, keys_of
from cassie_mjx.cli.process import as_command
from cassie_mjx.cli.sweep import is_hydras, sweep, wants_hydra

C = TypeVar("C")


def parse(
    config_class: type[C],
    arguments: Sequence[str],
    groups: Mapping[str, Group] | None = None,
    renamed: Mapping[str, str] | None = None,
) -> C:
    """Read `key=value` arguments into the frozen dataclass `config_class`; a tuple is `key=1,2` or `key=[1,2]`.

    Args:
      config_class: its fields are the keys; those of a field that is a dataclass have its name and a dot in front.
      arguments: of the command line; of two for one key the later counts.
      groups: keys that have presets; these count first, wherever they stand.
      renamed: old to new names of keys; an old one that ends in a dot stands for all keys that begin with it.

    Raises:
      ValueError: an argument that is not `key=value`, an unknown key, preset or choice, a value that is no YAML or of
        the wrong type, or a key that must be given and is not; the message says which ones there are.
    """
    groups = groups or {}
    keys = keys_of(config_class, groups)
    given = dict(_setting(argument, keys, renamed or {}) for argument in arguments)
    values = {name: key.default for name, key in keys.items()}
    for name, group in groups.items():
        if name in given:
            values |= flatten(group.presets[given[name]], name)
    values |= given
    if missing := [name for name, value in values.items() if value is MISSING]:
        raise ValueError(f"{' and '.join(missing)} must be given, as in {' '.join(f'{each}=...' for each in missing)}")
    return build(config_class, values)


def run(
    main: Callable[[C], None],
    config_class: type[C],
    groups: Mapping[str, Group] | None = None,
    renamed: Mapping[str, str] | None = None,
) -> None:
    """Run a command: read `sys.argv`, call `main`; `--help` explains every key, `-m` runs all combinations of values.

    A ValueError or OSError ends it with one sentence and status 2, Ctrl-C with one word and status 130.
    """

    def job(arguments: Sequence[str]) -> None:
        # All of it here, for a launcher of Hydra's may take the job to another process.
        with _one_sentence():
            keep_compiled_programs()
            main(parse(config_class, arguments, groups))

    typed = sys.argv[1:]
    if {"-h", "--help"} & set(typed):
        _show(explain(sys.modules[main.__module__].__doc__ or "", config_class, groups or {}))
        return
    with _one_sentence():
        # Before the first of many jobs, so that no key is unknown to any, and each old name is told once.
        keys, hydra = keys_of(config_class, groups or {}), wants_hydra(typed)
        arguments = [
            each if hydra and is_hydras(each) else "=".join(_split(each, keys, renamed or {})) for each in typed
        ]
        if hydra:
            sweep(arguments, job)
        else:
            job(arguments)


def _show(text: str) -> None:
    try:
        print(text, flush=True)
    except BrokenPipeError:
        # `head` has seen enough; without this, Python would complain as it closes the pipe.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextmanager
def _one_sentence() -> Iterator[None]:
    try:
        with as_command():
            yield
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


def _setting(argument: str, keys: Mapping[str, Key], renamed: Mapping[str, str]) -> tuple[str, Any]:
    """The key that an argument names, and its value of the key's type."""
    name, text = _split(argument, keys, renamed)
    key = keys[name]
    value = _typed(f"{name}={text}", _read(name, text, key.kind), key.kind)
    if key.choices:
        check_choice(name, value, key.choices)
    return name, value


def _split(argument: str, keys: Mapping[str, Key], renamed: Mapping[str, str]) -> tuple[str, str]:
    """The known key that an argument names, and the text of its value."""
    name, equals, text = argument.partition("=")
    if not equals:
        raise ValueError(f"{argument!r} is not of the form key=value; the keys are {', '.join(_level(keys, ''))}.")
    for old, new in renamed.items():
        if name == old or (old.endswith(".") and name.startswith(old)):
            now = new + name.removeprefix(old)
            print(f"{name} is now called {now}.", file=sys.stderr)
            name = now
    if name not in keys:
        raise ValueError(_unknown(name, keys))
    return name, text


def _unknown(name: str, keys: Mapping[str, Key]) -> str:
    """A sentence about a key that does not exist: the keys beside it, and the nearest of all."""
    parts = name.split(".")
    prefixes = (".".join(parts[:length]) + "." for length in range(len(parts), 0, -1))
    prefix = next((each for each in prefixes if _level(keys, each)), "")
    # push_n is that of walk.scenario, however little alike the two are.
    below = [known for known in keys if known.endswith(f".{name}")]
    hint = f" Did you mean {below[0]}?" if below else did_you_mean(name, list(keys))
    return f"{name!r} is not a key; the keys are {', '.join(_level(keys, prefix))}.{hint}"


def _level(keys: Mapping[str, Key], prefix: str) -> list[str]:
    """Names of the keys below `prefix`, those of one deeper level as one."""
    return list(dict.fromkeys(name.removeprefix(prefix).split(".")[0] for name in keys if name.startswith(prefix)))


def _is_tuple(kind: Any) -> bool:
    return tuple in (get_origin(kind), *map(get_origin, get_args(kind)))


def _read(name: str, text: str, kind: Any) -> Any:
    """A value as YAML. Raise ValueError if it is none."""
    if kind is str and not text:
        return ""
    bracketed = _is_tuple(kind) and not text.startswith("[") and text != "null"
    try:
        return OmegaConf.from_dotlist([f"value=[{text}]" if bracketed else f"value={text}"])["value"]
    except yaml.YAMLError as error:
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise ValueError(
            f"{f'{name}={text}'!r} has a value that is no YAML ({problem}); close its brackets, or put it in quotes "
            f"that the shell keeps, \"{name}='...'\"."
        ) from error
    except OmegaConfBaseException as error:
        raise ValueError(f"{name}={text}: {str(error).splitlines()[0]}.") from error


def _typed(argument: str, value: Any, kind: Any) -> Any:
    """The value as one of a key of that type. Raise ValueError if it cannot be."""
    schema = OmegaConf.structured(make_dataclass("Value", [("value", kind)]))
    try:
        typed = OmegaConf.to_container(OmegaConf.merge(schema, {"value": value}))
    except OmegaConfBaseException as error:
        several = f" -m {argument} runs one after another." if "," in argument else ""
        raise ValueError(f"{argument}: {str(error).splitlines()[0]}.{several}") from error
    assert isinstance(typed, dict)
    return tuple(typed["value"]) if isinstance(typed["value"], list) else typed["value"]
