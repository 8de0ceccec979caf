"""The keys of a command: the fields of its configuration, nested ones with a dot, as `key=value` names them."""

import ast
import inspect
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from functools import cache
from typing import Any, NamedTuple, TypeVar, get_type_hints

from cassie_mjx.configuration.values import Allowed, allowed

C = TypeVar("C")


class Group(NamedTuple):
    """Presets of a key whose value is a dataclass itself: `ppo=paper`, and then `ppo.gamma=0.98` on top."""

    default: str
    presets: Mapping[str, Any]


class Key(NamedTuple):
    """One key."""

    kind: Any
    """Type of its value."""
    default: Any
    """`dataclasses.MISSING` if the key must be given."""
    allowed: Allowed
    """What its value can be, apart from its type."""
    doc: str
    """What stands under the field."""


def present_name(name: str, renamed: Mapping[str, str]) -> str:
    """The name that a key has today.

    Args:
      name: of today or of before.
      renamed: old to new names; an old one that ends in a dot stands for all keys that begin with it.
    """
    old = next((old for old in renamed if name == old or (old.endswith(".") and name.startswith(old))), None)
    return name if old is None else renamed[old] + name.removeprefix(old)


def keys_of(config_class: type, groups: Mapping[str, Group]) -> dict[str, Key]:
    """All keys of a configuration by their dotted names.

    Args:
      config_class: frozen dataclass whose fields are the keys; those of a field that is a dataclass follow it.
      groups: fields that have presets; each is a key whose value is a preset's name.
    """
    return dict(_keys(config_class, MISSING, groups, ""))


def _keys(config_class: type, instance: Any, groups: Mapping[str, Group], prefix: str) -> Iterator[tuple[str, Key]]:
    kinds, docs, known = get_type_hints(config_class), field_docs(config_class), allowed(config_class)
    for field in fields(config_class):
        name, kind, doc = prefix + field.name, kinds[field.name], docs.get(field.name, "")
        default = _default(field) if instance is MISSING else getattr(instance, field.name)
        if group := groups.get(name):
            yield name, Key(str, group.default, Allowed(tuple(group.presets)), doc)
            default = group.presets[group.default]
        if is_dataclass(kind):
            assert isinstance(kind, type)
            yield from _keys(kind, default, groups, f"{name}.")
        else:
            yield name, Key(kind, default, known[field.name], doc)


def _default(field: Field[Any]) -> Any:
    return field.default if field.default_factory is MISSING else field.default_factory()


def flatten(config: Any, prefix: str) -> dict[str, Any]:
    """The values of a configuration by their dotted names, all with `prefix` and a dot in front."""
    flat: dict[str, Any] = {}
    for field in fields(config):
        name, value = f"{prefix}.{field.name}", getattr(config, field.name)
        flat |= flatten(value, name) if is_dataclass(value) else {name: value}
    return flat


def build(config_class: type[C], values: Mapping[str, Any], prefix: str = "") -> C:
    """The configuration of these values by dotted name. Raises ValueError for what it objects to itself."""
    kinds = get_type_hints(config_class)
    names = [field.name for field in fields(config_class)]  # type: ignore[arg-type]
    return config_class(
        **{
            name: build(kinds[name], values, f"{prefix}{name}.") if is_dataclass(kinds[name]) else values[prefix + name]
            for name in names
        }
    )


@cache
def field_docs(config_class: type) -> dict[str, str]:
    """The docstring under each field of a dataclass and of those that it inherits from, in one line."""
    docs: dict[str, str] = {}
    for owner in reversed(config_class.__mro__):
        if not is_dataclass(owner):
            continue
        body = ast.parse(textwrap.dedent(inspect.getsource(owner))).body[0]
        assert isinstance(body, ast.ClassDef)
        for node, after in zip(body.body, body.body[1:], strict=False):
            match node, after:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                    docs[name] = " ".join(text.split())
    return docs
