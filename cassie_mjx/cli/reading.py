"""What the text of a value means. A text is taken as it was typed; only null, numbers and tuples are read at all."""

import csv
import re
from types import NoneType
from typing import Any, get_args, get_origin

BOOLEANS = {"true": True, "yes": True, "on": True, "1": True, "false": False, "no": False, "off": False, "0": False}


def read(argument: str, text: str, kind: Any) -> Any:
    """The value of type `kind` that a text stands for.

    Args:
      argument: that it is the value of, for the sentence.
      text: for a tuple, values with commas between, in brackets or not; one with a comma in it stands in quotes, '...'.
      kind: str, int, float, bool, a tuple of one of these, or one of all these or None.

    Raises:
      ValueError: it stands for none.
    """
    if NoneType in get_args(kind):
        (kind,) = (each for each in get_args(kind) if each is not NoneType)
        if text == "null":
            return None
    if get_origin(kind) is tuple:
        listed = text[1:-1] if text.startswith("[") and text.endswith("]") else text
        return tuple(read(argument, each, get_args(kind)[0]) for each in parts(argument, listed))
    if kind is str:
        return text
    readers = {bool: (_boolean, "true or false"), int: (_whole, "a whole number"), float: (float, "a number")}
    reader, wanted = readers[kind]
    try:
        return reader(text)
    except ValueError as error:
        several = f"; -m {argument} runs one after another" if "," in text else ""
        raise ValueError(f"{argument}: {text!r} is not {wanted}{several}.") from error


def values_of(argument: str, text: str, kind: Any) -> list[str]:
    """The texts of the values, with commas between, that a key of type `kind` is to have one after another."""
    if tuple in (get_origin(kind), *map(get_origin, get_args(kind))):
        return re.findall(r"\[[^]]*\]|[^,]+", text)
    return parts(argument, text)


def parts(argument: str, text: str) -> list[str]:
    """What stands between the commas of a text; quotes around a part, '...', keep the commas in it."""
    try:
        return next(csv.reader([text], quotechar="'", skipinitialspace=True), [])
    except csv.Error as error:
        raise ValueError(f"{argument!r} has a line break in its values; leave it out.") from error


def _boolean(text: str) -> bool:
    if text.lower() not in BOOLEANS:
        raise ValueError
    return BOOLEANS[text.lower()]


def _whole(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        if (number := float(text)).is_integer():
            return int(number)
        raise
