"""Arguments as the plain numbers that config.json holds, from Python or NumPy. A run with another
value there could not be opened."""

from __future__ import annotations

import math
import typing
from collections.abc import Mapping, Sequence
from numbers import Integral, Real
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from scene_experts.core.errors import InputError
from scene_experts.core.fields import check_value, notes_of

T = TypeVar("T")


def integer(name: str, value: object, least: int | None = None) -> int:
    """Return an integer of at least `least`. Raises InputError, naming the argument, for anything
    else."""
    if isinstance(value, bool) or not isinstance(value, Integral) or (least is not None and value < least):
        what = "an integer" if least is None else f"an integer of at least {least}"
        raise InputError(f"expected {name} as {what}, found {value!r}; correct it")
    return int(value)


def real(name: str, value: object) -> float:
    """Return a finite number as a float. Raises InputError, naming the argument, for anything
    else."""
    if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value):
        raise InputError(f"expected {name} as a finite number, found {value!r}; correct it")
    return float(value)


def boolean(name: str, value: object) -> bool:
    """Return True or False. Raises InputError, naming the argument, for anything else."""
    if not isinstance(value, (bool, np.bool_)):
        raise InputError(f"expected {name} as True or False, found {value!r}; correct it")
    return bool(value)


def side(name: str, value: object) -> int:
    """Return the length of a picture's side, px. Raises InputError, naming the argument, for anything
    but an integer of at least 1."""
    return integer(f"{name} in px", value, 1)


def size(name: str, value: object) -> tuple[int, int] | None:
    """Return the width and height of a picture, px; None for None. Raises InputError, naming the
    argument, for anything else."""
    if value is None:
        return None
    if not isinstance(value, (tuple, list, np.ndarray)) or np.shape(value) != (2,):
        raise InputError(f"expected {name} as a width and a height, found {value!r}; correct it")
    return side(f"the width in {name}", value[0]), side(f"the height in {name}", value[1])


def path(name: str, value: object) -> Path:
    """Return a path that stays the same when the working folder changes. Raises InputError, naming
    the argument, for anything but a path."""
    if not isinstance(value, (str, Path)) or not str(value):
        raise InputError(f"expected {name} as a path, found {value!r}; correct it")
    return Path(value).absolute()


def fields(kind: type[T], given: Mapping[str, Any]) -> T:
    """Return a dataclass of options from the values in `given` that have the names of its fields.

    Raises InputError, naming the argument, for a value of another type or out of range.
    """
    values = {name: _of_type(inner, name, given[name]) for name, (inner, _) in notes_of(kind).items() if name in given}
    for name, value in values.items():
        check_value(kind, name, value, name)
    return kind(**values)


def _of_type(kind: Any, name: str, value: Any) -> Any:
    inner = [each for each in typing.get_args(kind) if each is not type(None)] if _optional(kind) else [kind]
    if value is None and _optional(kind):
        return None
    if typing.get_origin(inner[0]) is tuple:
        wanted = typing.get_args(inner[0])
        if wanted[1:] == (Ellipsis,):
            if isinstance(value, str) or not isinstance(value, Sequence):
                raise InputError(f"expected {name} as a list, found {value!r}; write it in brackets")
            return tuple(_of_type(wanted[0], name, part) for part in value)
        if not isinstance(value, (tuple, list, np.ndarray)) or len(value) != len(wanted):
            raise InputError(f"expected {name} as {len(wanted)} numbers, found {value!r}; correct it")
        return tuple(_of_type(each, name, part) for each, part in zip(wanted, value))
    if inner[0] is str and not isinstance(value, str):
        raise InputError(f"expected {name} as text, found {value!r}; write it in quotes")
    known = {bool: boolean, int: integer, float: real}.get(inner[0])
    return value if known is None else known(name, value)


def _optional(kind: Any) -> bool:
    return type(None) in typing.get_args(kind)
