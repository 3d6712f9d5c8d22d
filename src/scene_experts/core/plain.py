"""Convert dataclasses to plain JSON values and back."""

from __future__ import annotations

import dataclasses
import functools
import types as pytypes
import typing
from pathlib import Path
from typing import Any, Literal

from scene_experts.core.errors import InputError
from scene_experts.core.fields import default_of
from scene_experts.core.parts import Part, find, names_of
from scene_experts.core.reading.source import shorten


class UnknownPart(InputError):
    """A configuration contains a part that is not registered."""


def to_json(value: Any) -> Any:
    """Convert nested dataclasses to plain JSON values. Each dataclass stores its class name under
    "type"."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        out = {f.name: to_json(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return {"type": type(value).__name__, **out}
    if isinstance(value, dict):
        return {str(k): to_json(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_json(v) for v in value]
    return str(value) if isinstance(value, Path) else value


def lean(value: Any) -> Any:
    """Convert nested dataclasses to plain JSON values without the settings that have the default of
    their dataclass.

    `from_json` reads the result back. A part with `changes` has `Part.version` under "version".
    """
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        return to_json(value)
    own = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    kept = {f.name: lean(own[f.name]) for f in dataclasses.fields(value) if own[f.name] != default_of(f) or versions_of(own[f.name])}
    version = {"version": value.version()} if isinstance(value, Part) and value.version() else {}
    return {"type": type(value).__name__, **version, **kept}


def versions_of(value: Any) -> bool:
    """Whether a dataclass or one in it is a part with `changes`."""
    if not dataclasses.is_dataclass(value):
        return False
    changed = isinstance(value, Part) and value.version() > 0
    return changed or any(versions_of(getattr(value, f.name)) for f in dataclasses.fields(value))


def from_json(kind: Any, value: Any, where: str = "config") -> Any:
    """Convert a value that `to_json` wrote to the type `kind`. A field for a part accepts all
    registered subclasses of its type.

    Raises InputError, which names the location, if a value does not fit, and UnknownPart if a part
    is not registered.
    """
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, pytypes.UnionType):
        return _from_union(args, value, where)
    if isinstance(kind, type) and issubclass(kind, Part):
        return _from_object(_part_named(kind, value, where), value, where)
    if dataclasses.is_dataclass(kind):
        return _from_object(kind, value, where)
    if origin is Literal:
        if not isinstance(value, (str, int, float, bool, type(None))) or value not in args:
            raise InputError(f"expected one of {list(args)} at {where}, found {_shown(value)}; correct the file")
        return value
    if origin is tuple:
        _expect(isinstance(value, list), "a list", where, value)
        inner = [args[0]] * len(value) if len(args) == 2 and args[1] is Ellipsis else list(args)
        _expect(len(inner) == len(value), f"{len(inner)} values", where, value)
        return tuple(from_json(k, v, f"{where}[{i}]") for i, (k, v) in enumerate(zip(inner, value)))
    if origin is dict:
        _expect(isinstance(value, dict), "an object", where, value)
        return {k: from_json(args[1], v, f"{where}.{k}") for k, v in value.items()}
    if kind is Path:
        _expect(isinstance(value, str), "a path", where, value)
        return Path(value)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    _expect(isinstance(value, kind) and not (kind is int and isinstance(value, bool)), f"a {kind.__name__}", where, value)
    return value


def _part_named(kind: type[Part], value: Any, where: str) -> type[Part]:
    """Return the class of the part that `value` names."""
    _expect(isinstance(value, dict), "an object", where, value)
    name = value.get("type", kind.__name__)
    part = find(name, kind) if isinstance(name, str) else None
    if part is None:
        raise UnknownPart(
            f"expected one of {names_of(kind)} at {where}, found {_shown(name)}; install or import the package that defines it"
        )
    return part


def _from_union(args: tuple[Any, ...], value: Any, where: str) -> Any:
    if value is None and type(None) in args:
        return None
    options = [a for a in args if a is not type(None)]
    if len(options) == 1:
        return from_json(options[0], value, where)
    for option in options:
        if isinstance(value, dict) and getattr(option, "__name__", None) == value.get("type"):
            return from_json(option, value, where)
    found = value["type"] if isinstance(value, dict) and "type" in value else value
    raise InputError(
        f"expected one of {[getattr(o, '__name__', str(o)) for o in options]} at {where}, found {_shown(found)}; correct the file"
    )


def _from_object(kind: Any, value: Any, where: str) -> Any:
    _expect(isinstance(value, dict), "an object", where, value)
    hints = _hints(kind)
    known = {f.name for f in dataclasses.fields(kind)}
    unknown = set(value) - known - {"type", "version"}
    _expect(not unknown, f"only the keys {sorted(known)}", where, sorted(unknown))
    needed = [f.name for f in dataclasses.fields(kind) if f.default is f.default_factory is dataclasses.MISSING]
    _expect(not set(needed) - set(value), f"the keys {needed}", where, sorted(set(value) - {"type"}))
    return kind(**{name: from_json(hints[name], item, f"{where}.{name}") for name, item in value.items() if name in known})


@functools.cache
def _hints(kind: type) -> dict[str, Any]:
    """Return the types of a dataclass's fields, without their annotations."""
    return typing.get_type_hints(kind)


def _expect(fits: bool, what: str, where: str, found: Any) -> None:
    if not fits:
        raise InputError(f"expected {what} at {where}, found {_shown(found)}; correct the file or start a new run")


def _shown(value: Any) -> str:
    return shorten(repr(value))


MOST_DIFFERENCES = 5  # that an error message lists


def differences(old: Any, new: Any, where: str = "") -> list[str]:
    """Return the differences of two nested values in order, for example ["loss.load was 0.01, is
    now 0.5"]."""
    if isinstance(old, dict) and isinstance(new, dict) and old.keys() == new.keys():
        return [found for key in old for found in differences(old[key], new[key], f"{where}.{key}".lstrip("."))]
    return [] if old == new else [f"{where} was {old}, is now {new}"]
