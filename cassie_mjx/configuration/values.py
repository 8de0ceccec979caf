"""What each value of a configuration can be: its choices and its range, stated once, at the field."""

import difflib
import zlib
from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from functools import cache
from numbers import Integral, Real
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, ClassVar, NamedTuple, Self, cast, get_args, get_origin, get_type_hints
from urllib.parse import quote

FILES = ("out", "plot", "strip")
"""The fields that name result files, where a configuration has them."""

LONGEST = 120
"""Characters of a label; file systems take 255 in a name."""


class Range(NamedTuple):
    """From where to where a number can be, both ends included: `seconds: Annotated[float, Range(0.01, 3600)]`.

    Every number of a command has one. It keeps out what can only crash, hang or mean nothing, and nothing else.
    """

    least: float
    greatest: float

    def __str__(self) -> str:
        return f"from {self.least:,} to {self.greatest:,}"


Seed = Annotated[int, Range(0, 2**32 - 1)]
"""What random numbers come from."""


class Allowed(NamedTuple):
    """What a field's value can be, apart from its type."""

    choices: Collection[str] = ()
    """Its choices; empty if any text will do."""
    range: Range | None = None
    """Where it can be, or each of a tuple's numbers; None if it holds no number."""
    whole: bool = False
    """Whether its numbers are whole ones."""
    length: int | None = None
    """How many values it has; None if that is free, or it is no tuple."""
    optional: bool = False
    """Whether it can be null."""
    several: bool = False
    """Whether it is a tuple."""

    def check(self, name: str, value: Any) -> None:
        """Raise ValueError if the value of the field of that name cannot be; the sentence says what can."""
        if value is None and self.optional:
            return
        if isinstance(value, tuple | list) != self.several:
            raise ValueError(f"{name}={shown(value)} must be {'a tuple of values' if self.several else 'one value'}.")
        values = value if isinstance(value, tuple | list) else (value,)
        unknown = [each for each in values if self.choices and each not in self.choices]
        if unknown:
            hint = did_you_mean(str(unknown[0]), self.choices)
            raise ValueError(f"{name}={shown(value)} is not known; choose one of {', '.join(self.choices)}.{hint}")
        if self.length not in (None, len(values)):
            raise ValueError(f"{name}={shown(value)} must be {self.length} values, with commas between.")
        if not all(self._within(each) for each in values):
            which, kind = ": each" if values is value else "", "a whole number " if self.whole else ""
            raise ValueError(f"{name}={shown(value)}{which} must be {kind}{self.span()}.")

    def span(self) -> str:
        """The range in words, and null if it can be that; empty without a range."""
        return f"{self.range}{', or null' if self.optional else ''}" if self.range else ""

    def _within(self, value: Any) -> bool:
        if not self.range:
            return True
        # NaN is in no range.
        return isinstance(value, self._number) and bool(self.range.least <= cast(Any, value) <= self.range.greatest)

    @property
    def _number(self) -> type:
        return Integral if self.whole else Real


class Checked:
    """Base of a configuration, a frozen dataclass: one that exists has no value out of its range or choices.

    The choices of a field of text are in `CHOICES`, a class variable: name of the field to names that it can have.

    Raises:
      ValueError: a value cannot be; the sentence names the field, the value and what would work.
    """

    def __post_init__(self) -> None:
        """Check every value. A subclass that has more to check does so after this."""
        for name, field in allowed(type(self)).items():
            field.check(name, getattr(self, name))

    def apart(self, swept: Mapping[str, str]) -> Self:
        """One combination of a sweep, with result files of its own.

        Args:
          swept: texts of the values that differ between the combinations, by key. The files are named after them.
        """
        files = {name: Path(path) for name in FILES if (path := getattr(self, name, ""))}
        name_of = label({key: value for key, value in swept.items() if key not in FILES})
        own = {name: str(path.with_stem(f"{path.stem}-{name_of}")) for name, path in files.items() if name_of}
        return replace(cast(Any, self), **own)


def label(swept: Mapping[str, str]) -> str:
    """A name of values, by key, that a file can have: for other values it is another one."""
    name = "-".join(f"{key}={quote(value, safe='=+')}" for key, value in sorted(swept.items()))
    return name if len(name) <= LONGEST else f"{name[:LONGEST]}-{zlib.crc32(name.encode()):08x}"


@cache
def allowed(config_class: type) -> dict[str, Allowed]:
    """What the value of each field can be; `CHOICES` of the class and of those that it inherits from count."""
    owners = reversed(config_class.__mro__)
    choices = {name: known for owner in owners for name, known in vars(owner).get("CHOICES", {}).items()}
    return {
        name: _allowed(kind, choices.get(name, ()))
        for name, kind in get_type_hints(config_class, include_extras=True).items()
        if get_origin(kind) is not ClassVar
    }


def _allowed(kind: Any, choices: Collection[str]) -> Allowed:
    parts = list(_parts(kind))
    ranges = [each for part in parts for each in getattr(part, "__metadata__", ()) if isinstance(each, Range)]
    tuples = [get_args(part) for part in parts if get_origin(part) is tuple]
    length = len(tuples[0]) if tuples and ... not in tuples[0] else None
    return Allowed(choices, ranges[0] if ranges else None, int in parts, length, NoneType in parts, bool(tuples))


def _parts(kind: Any) -> Iterator[Any]:
    """A type and all that it is made of."""
    yield kind
    for part in get_args(kind):
        yield from _parts(part)


def shown(value: Any) -> str:
    """A value as a command line gives it."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple | list):
        return ",".join(map(shown, value)) or "[]"
    return str(value)


def did_you_mean(given: str, known: Collection[str]) -> str:
    """A question that names the known word nearest to the given one, after a blank; empty if none is near."""
    near = difflib.get_close_matches(given, known, 1)
    return f" Did you mean {near[0]}?" if near else ""
