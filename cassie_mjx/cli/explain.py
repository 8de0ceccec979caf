"""What `--help` prints: every key of a command with its sentence, its default and its choices."""

import ast
import inspect
import shutil
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, fields, is_dataclass
from functools import cache
from typing import Any


def explain(doc: str, config_class: type, groups: Mapping[str, Any]) -> str:
    """The help of a command.

    Args:
      doc: docstring of its module; the first paragraph is shown.
      config_class: its configuration.
      groups: keys that have presets (`command_line.Group`).
    """
    width = min(shutil.get_terminal_size((120, 24)).columns, 120)
    first = inspect.cleandoc(doc).split("\n\n")[0]
    parts = [textwrap.fill(" ".join(first.split()), width), "Keys, as key=value:"]
    for key, group in groups.items():
        parts.append(_entry(key, f"Presets: {', '.join(group.presets)}.", group.default, width))
    parts += [_entry(key, text, default, width) for key, text, default in _keys(config_class, groups)]
    if groups:
        parts.append("-m runs all combinations of values: -m seed=0,1,2")
    return "\n\n".join(parts)


@cache
def field_docs(config_class: type) -> dict[str, str]:
    """The docstring under each field of a dataclass and of those that it inherits from."""
    docs: dict[str, str] = {}
    for owner in reversed(config_class.__mro__):
        if not is_dataclass(owner):
            continue
        body = ast.parse(textwrap.dedent(inspect.getsource(owner))).body[0]
        assert isinstance(body, ast.ClassDef)
        name = None
        for node in body.body:
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                name = node.target.id
            elif name and isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
                docs[name] = " ".join(inspect.cleandoc(str(node.value.value)).split())
                name = None
            else:
                name = None
    return docs


def _keys(config_class: type, groups: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str, Any]]:
    docs = field_docs(config_class)
    choices = {name: known for owner in reversed(config_class.__mro__) for name, known in _own_choices(owner)}
    for field in fields(config_class):
        default = _default(field)
        if is_dataclass(default):
            yield from _keys(type(default), {}, f"{prefix}{field.name}.")
            continue
        known = choices.get(field.name)
        more = f" Choices: {', '.join(known)}." if known else ""
        yield f"{prefix}{field.name}", docs.get(field.name, "") + more, default


def _own_choices(owner: type) -> list[tuple[str, Sequence[str]]]:
    """What a class itself says of the values of its keys, in `CHOICES`."""
    return list(vars(owner).get("CHOICES", {}).items())


def _default(field: Field[Any]) -> Any:
    if field.default is not MISSING:
        return field.default
    return MISSING if field.default_factory is MISSING else field.default_factory()


def _entry(key: str, text: str, default: Any, width: int) -> str:
    shown = f"{key}=..." if default is MISSING else f"{key}={_shown(default)}"
    return f"  {shown}\n{textwrap.fill(text, width, initial_indent='      ', subsequent_indent='      ')}"


def _shown(value: Any) -> str:
    """A default as a command line gives it."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
