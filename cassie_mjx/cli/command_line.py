"""`key=value` command lines as frozen dataclasses: one way to read, explain and run every command."""

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING
from pathlib import Path
from typing import Any, TypeVar

from cassie_mjx.cli.ending import one_sentence, plain_words
from cassie_mjx.cli.explain import explain
from cassie_mjx.cli.keys import Group, Key, build, flatten, keys_of, present_name
from cassie_mjx.cli.reading import read
from cassie_mjx.cli.sweep import is_hydras, sweep, wants_hydra
from cassie_mjx.configuration.values import Checked, did_you_mean

C = TypeVar("C", bound=Checked)


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
      ValueError: an argument that is not `key=value`, an unknown key or preset, a value of the wrong type, out of
        its range or none of its choices, or a key that must be given and is not; the message says what would work.
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
    complete: Callable[[Sequence[str]], Sequence[str]] = list,
) -> None:
    """Run a command: read `sys.argv`, call `main`; `--help` explains every key, `-m` runs all combinations of values.

    A ValueError or OSError ends it with one sentence and status 2, Ctrl-C with one word and status 130. In a sweep, it
    ends that combination alone, and the sweep has status 2.

    Args:
      main: what the command does.
      config_class: its configuration.
      groups: keys that have presets.
      renamed: old to new names of keys.
      complete: the arguments of one run, with those that the machine decides where the user has not.
    """

    def job(arguments: Sequence[str], swept: Mapping[str, str]) -> None:
        # All of it here, for a launcher of Hydra's may take the job to another process.
        with plain_words():
            keep_compiled_programs()
            config = parse(config_class, complete(arguments), groups)
            main(config.apart(swept) if swept else config)

    typed = sys.argv[1:]
    if {"-h", "--help"} & set(typed):
        _show(explain(sys.modules[main.__module__].__doc__ or "", config_class, groups or {}))
        return
    with one_sentence():
        # Before the first of many jobs, so that no key is unknown to any, and each old name is told once.
        keys, hydra = keys_of(config_class, groups or {}), wants_hydra(typed)
        arguments = [
            each if hydra and is_hydras(each) else "=".join(_split(each, keys, renamed or {})) for each in typed
        ]
        if hydra:
            sweep(arguments, keys, job)
        else:
            job(arguments, {})


def _show(text: str) -> None:
    try:
        print(text, flush=True)
    except BrokenPipeError:
        # `head` has seen enough; without this, Python would complain as it closes the pipe.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def keep_compiled_programs() -> None:
    """Keep what XLA compiles, if JAX is in use, in a folder of the user's unless the environment names another one."""
    jax = sys.modules.get("jax")
    if not jax or jax.config.jax_compilation_cache_dir:
        return
    # A user may have no home, or may not write there; it is compiled anew each time then.
    with suppress(OSError, RuntimeError):
        folder = Path.home() / ".cache" / "cassie-mjx"
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            jax.config.update("jax_compilation_cache_dir", str(folder))


def _setting(argument: str, keys: Mapping[str, Key], renamed: Mapping[str, str]) -> tuple[str, Any]:
    """The key that an argument names, and its value, which can be."""
    name, text = _split(argument, keys, renamed)
    value = read(f"{name}={text}", text, keys[name].kind)
    keys[name].allowed.check(name, value)
    return name, value


def _split(argument: str, keys: Mapping[str, Key], renamed: Mapping[str, str]) -> tuple[str, str]:
    """The known key that an argument names, and the text of its value."""
    name, equals, text = argument.partition("=")
    if not equals:
        word, _, value = argument.lstrip("-").partition(":")
        hint = f" Write {word}={value or 'VALUE'}." if word in keys else ""
        raise ValueError(
            f"{argument!r} is not of the form key=value; the keys are {', '.join(_level(keys, ''))}.{hint}"
        )
    if (now := present_name(name, renamed)) != name:
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
    hint = f" Did you mean {below[0]}?" if below else did_you_mean(name.lstrip("-"), list(keys))
    return f"{name!r} is not a key; the keys are {', '.join(_level(keys, prefix))}.{hint}"


def _level(keys: Mapping[str, Key], prefix: str) -> list[str]:
    """Names of the keys below `prefix`, those of one deeper level as one."""
    return list(dict.fromkeys(name.removeprefix(prefix).split(".")[0] for name in keys if name.startswith(prefix)))
