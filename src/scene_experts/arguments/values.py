"""Convert command-line arguments to the type of a field. Errors are one sentence."""

from __future__ import annotations

import typing
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

from scene_experts.arguments.table import members
from scene_experts.core.errors import InputError, nearest

NONE = ("none", "None")
LONG = 40  # characters; longer choices are listed in the text beside an option
FEW = 4  # with at most this many choices, errors do not suggest the nearest one
WORDS: dict[Any, tuple[str, str, Callable[[str], Any]]] = {
    int: ("a whole number", "N", int),
    float: ("a number", "X", float),
    str: ("a value", "TEXT", str),
    Path: ("a path", "PATH", Path),
}
"""Basic types: their name in messages, their placeholder in the help, and the function that
converts an argument."""


def count(kind: Any) -> tuple[int, int | None]:
    """Return the minimum and maximum number of arguments of a value. A maximum of None means any
    number."""
    inner, optional = without_none(kind)
    if inner is bool:
        return 0, 0
    if typing.get_origin(inner) is not tuple:
        return 1, 1
    many = len(each := typing.get_args(inner)) == 2 and each[1] is Ellipsis
    return (1, None) if many else (1 if optional else len(each), len(each))


def convert(kind: Any, words: Sequence[str], name: str, example: str) -> Any:
    """Convert arguments to a value of type `kind`. "none" becomes None or an empty tuple.

    Raises InputError, which names the option `name` and shows a valid `example`, if an argument is
    invalid.
    """
    inner, optional = without_none(kind)
    many = count(inner)[1] is None
    if (optional or many) and len(words) == 1 and words[0] in NONE:
        return None if optional else ()
    if typing.get_origin(inner) is not tuple:
        return _one(inner, words[0], name, example)
    each = typing.get_args(inner)
    least, most = count(inner)
    if most is not None and len(words) != most:
        raise InputError(f"expected {least} values after {name}, found {len(words)}; write {example}")
    kinds = [each[0]] * len(words) if most is None else each
    return tuple(_one(one, word, name, example) for one, word in zip(kinds, words))


def _one(kind: Any, word: str, name: str, example: str) -> Any:
    if typing.get_origin(kind) is Literal:
        known = {str(choice): choice for choice in typing.get_args(kind)}
        if word not in known:
            hint = nearest(word, known) if len(known) > FEW else ""
            raise InputError(f"expected {describe(kind)} after {name}, found '{word}'{hint or '; choose one of these'}")
        return known[word]
    what, _, make = WORDS[kind]
    try:
        return make(word)
    except ValueError:
        raise InputError(f"expected {what} after {name}, found '{word}'; write for example {example}") from None


def describe(kind: Any) -> str:
    """Return the name of a type in messages, for example "a whole number" or "auto, cpu or
    cuda"."""
    inner, _ = without_none(kind)
    if typing.get_origin(inner) is Literal:
        *some, last = map(str, typing.get_args(inner))
        return f"{', '.join(some)} or {last}" if some else last
    if typing.get_origin(inner) is tuple:
        each, most = typing.get_args(inner), count(inner)[1]
        return f"one or more values ({describe(each[0])})" if most is None else f"{most} numbers"
    return WORDS[inner][0]


def list_choices(kind: Any) -> str:
    """Return the choices of a type, "a, b or c", or an empty string if the placeholder shows
    them."""
    inner, _ = without_none(kind)
    if typing.get_origin(inner) is tuple:
        inner = typing.get_args(inner)[0]
    return describe(inner) if typing.get_origin(inner) is Literal and placeholder(inner) == "NAME" else ""


def placeholder(kind: Any, name: str = "") -> str:
    """Return the placeholder of a value in the help: "N", "auto|cpu|cuda", "N ...". `name` replaces
    the name of the type."""
    inner, _ = without_none(kind)
    if inner is bool:
        return ""
    if typing.get_origin(inner) is tuple:
        each, most = typing.get_args(inner), count(inner)[1]
        one = placeholder(each[0], name)
        return f"{one} ..." if most is None else " ".join(placeholder(kind, name) for kind in each)
    if name:
        return name
    if typing.get_origin(inner) is Literal:
        choices = "|".join(map(str, typing.get_args(inner)))
        return choices if len(choices) <= LONG else "NAME"
    return WORDS[inner][1]


def format_value(value: Any) -> str:
    """Format a value as on the command line."""
    if isinstance(value, tuple):
        return " ".join(map(format_value, value)) or NONE[0]
    return "none" if value is None else f"{value:g}" if isinstance(value, float) and float(f"{value:g}") == value else str(value)


def without_none(kind: Any) -> tuple[Any, bool]:
    """Return the type without None, and whether None is allowed. Raises TypeError for a union of
    several other types."""
    rest = [each for each in members(kind) if each is not type(None)]
    if len(rest) != 1:
        raise TypeError(f"an option cannot be one of {rest}")
    return rest[0], len(rest) < len(members(kind))
