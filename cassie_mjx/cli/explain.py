"""What `--help` prints: every key of a command with its sentence, its default, choices or range, and every preset."""

import inspect
import shutil
import textwrap
from collections.abc import Mapping
from dataclasses import MISSING
from typing import Any

from cassie_mjx.cli.keys import Group, Key, flatten, keys_of
from cassie_mjx.configuration.values import shown

WIDEST = 120
SWEEPS = """-m runs all combinations of values one after another: -m seed=0,1,2; a tuple is key=[1,2] then, and a text
with a comma in it is 'a,b', in quotes that the shell keeps. Each combination has result files or a run directory of its
own, named after its values; one that fails does not stop the others. A launcher of Hydra's takes them to a cluster:
-m hydra/launcher=NAME hydra.launcher.OPTION=VALUE, whose options are listed by hydra/launcher=NAME --cfg hydra -p
hydra.launcher."""


def explain(doc: str, config_class: type, groups: Mapping[str, Group]) -> str:
    """The help of a command, as wide as the terminal.

    Args:
      doc: docstring of its module; the first paragraph is shown.
      config_class: its configuration.
      groups: keys that have presets.
    """
    parts = [_filled(inspect.cleandoc(doc).split("\n\n")[0]), "Keys with their defaults, as key=value:"]
    for name, key in keys_of(config_class, groups).items():
        parts.append(_entry(_assigned(name, key.default), _text(name, key, groups)))
    for name, group in groups.items():
        parts.append(f"Presets of {name}, and what they change of {name}={group.default}:")
        parts += [_entry(f"{name}={preset}", _changes(name, group, preset)) for preset in group.presets]
    return "\n\n".join([*parts, _filled(SWEEPS)])


def _text(name: str, key: Key, groups: Mapping[str, Group]) -> str:
    kind = "Presets" if name in groups else "Choices"
    choices = f"{kind}: {', '.join(key.allowed.choices)}." if key.allowed.choices else ""
    span = f"{key.allowed.span().capitalize()}." if key.allowed.range else ""
    required = "It must be given." if key.default is MISSING else ""
    return " ".join(filter(None, (key.doc, choices, span, required)))


def _changes(name: str, group: Group, preset: str) -> str:
    base, values = (flatten(group.presets[each], name) for each in (group.default, preset))
    changed = [_assigned(key, value) for key, value in values.items() if value != base[key]]
    return " ".join(changed) or "The defaults above."


def _assigned(name: str, value: Any) -> str:
    """A key and its value as a command line gives them."""
    return f"{name}={'...' if value is MISSING else shown(value)}"


def _entry(title: str, text: str) -> str:
    return f"{_filled(title, '  ')}\n{_filled(text, '      ')}"


def _filled(text: str, indent: str = "") -> str:
    width = min(shutil.get_terminal_size((WIDEST, 24)).columns, WIDEST)
    return textwrap.fill(
        " ".join(text.split()), width, initial_indent=indent, subsequent_indent=indent, break_on_hyphens=False
    )
