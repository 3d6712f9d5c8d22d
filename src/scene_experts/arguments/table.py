"""List the options of a dataclass, one row per field with name, type and default, and create the
dataclass from given values."""

from __future__ import annotations

import dataclasses
import functools
import types
import typing
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from typing import Annotated, Any, Literal

from scene_experts.arguments.option import Option
from scene_experts.core.fields import Chosen, note, notes_of
from scene_experts.core.parts import Part, become, choice, choices

Place = tuple[str, ...]
"""Field names from the root to a value, for example ("cfg", "scene", "voxel_size")."""


@dataclass(frozen=True)
class Row:
    """One option."""

    flag: str
    """`--scene.voxel-size`"""
    place: Place
    kind: Any
    """Type of the value, without its annotation."""
    default: Any
    """dataclasses.MISSING where the option must be given."""
    option: Option
    owner: type
    """The dataclass that declares the field."""
    within: tuple[type, str] | None = None
    """The dataclass and field that hold the owner; None at the root."""
    part: Part | None = None
    """The default part, where the option chooses another one by its name."""

    @property
    def parts(self) -> dict[str, type[Part]]:
        """The parts that the option chooses among, by name; empty for other options."""
        return choices(notes_of(self.owner)[self.place[-1]][0]) if self.part is not None else {}

    @property
    def required(self) -> bool:
        return self.default is MISSING

    @property
    def negative(self) -> str:
        """The name that turns a switch off, for example `--growth.no-elimination`. Empty for other
        types."""
        before, dot, last = self.flag.rpartition(".")
        if self.kind is not bool:
            return ""
        return f"{before}{dot}no-{last}" if dot else f"--no-{last.removeprefix('--')}"

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(name for name in (self.flag, self.option.short, self.negative) if name)


def rows(kind: type, defaults: Mapping[str, Any]) -> list[Row]:
    """Return the options of a dataclass and its nested dataclasses, in the order of the fields.

    A field that accepts several dataclasses has the options of the class of its default.

    Args:
        kind: The dataclass.
        defaults: Values by dotted path ("data.split") that replace the defaults of the fields.
    """
    return _rows(kind, MISSING, "", (), defaults, None)


def _rows(kind: type, value: Any, prefix: str, place: Place, defaults: Mapping[str, Any], within: tuple[type, str] | None) -> list[Row]:
    out: list[Row] = []
    for field in fields(kind):
        option, inner = _annotation(kind, field.name)
        here = (*place, field.name)
        default = _default(field, value, here, defaults)
        part = _dataclass_of(inner, default)
        name = option.name if option.name is not None else field.name.replace("_", "-")
        if option.hidden or not field.init or (part is None and _may_be_dataclass(inner)):
            continue
        if part is not None and note(kind, field.name, Chosen) is not None:
            names = Literal[tuple(choices(inner))]  # type: ignore[valid-type]
            out.append(Row(f"--{prefix}{name}", here, names, default.name, option, kind, within, default))
        if part is not None:
            out += _rows(part, default, f"{prefix}{name}." if name else prefix, here, defaults, (kind, field.name))
        else:
            out.append(Row(f"--{prefix}{name}", here, inner, default, option, kind, within))
    return out


def choose_parts(kind: type, defaults: Mapping[str, Any], chosen: Callable[[Row], str | None]) -> dict[str, Any]:
    """Return the defaults with the parts that `chosen` names, for the rows that choose one.
    Settings that a part shares with the one that it replaces keep their values."""
    found = dict(defaults)
    for row in rows(kind, defaults):
        name = chosen(row) if row.part is not None else None
        if row.part is None or name is None or name == row.part.name:  # type: ignore[attr-defined]
            continue
        part = choice(name, notes_of(row.owner)[row.place[-1]][0])
        if part is not None:
            found[".".join(row.place)] = become(row.part, part)
    return found


def make(kind: type, given: Mapping[Place, Any], defaults: Mapping[str, Any]) -> Any:
    """Create a dataclass from the `given` values by place. Other fields have their defaults."""
    return _make(kind, MISSING, (), given, defaults)


def _make(kind: type, value: Any, place: Place, given: Mapping[Place, Any], defaults: Mapping[str, Any]) -> Any:
    changes: dict[str, Any] = {}
    for field in fields(kind):
        if not field.init:
            continue
        here = (*place, field.name)
        default = _default(field, value, here, defaults)
        part = _dataclass_of(_annotation(kind, field.name)[1], default)
        if here in given:
            changes[field.name] = given[here]
        elif part is not None:
            changes[field.name] = _make(part, default, here, given, defaults)
        else:
            changes[field.name] = default
    if value is MISSING:
        return kind(**changes)
    return replace(value, **{name: new for name, new in changes.items() if new is not getattr(value, name)})


def _default(field: dataclasses.Field[Any], value: Any, place: Place, defaults: Mapping[str, Any]) -> Any:
    if (dotted := ".".join(place)) in defaults:
        return defaults[dotted]
    if value is not MISSING:
        return getattr(value, field.name)
    return field.default_factory() if field.default_factory is not MISSING else field.default


@functools.cache
def _hints(kind: type) -> dict[str, Any]:
    return typing.get_type_hints(kind, include_extras=True)


def _annotation(kind: type, name: str) -> tuple[Option, Any]:
    """Return the Option of a field and its type."""
    hint = _hints(kind)[name]
    if typing.get_origin(hint) is not Annotated:
        return Option(), hint
    inner, *notes = typing.get_args(hint)
    return next((note for note in notes if isinstance(note, Option)), Option()), inner


def _dataclass_of(kind: Any, default: Any) -> type | None:
    """Return the dataclass whose fields are the options of a field, or None if the field itself is
    an option."""
    if is_dataclass(default) and not isinstance(default, type):
        return type(default)
    return kind if default is MISSING and isinstance(kind, type) and is_dataclass(kind) else None


def _may_be_dataclass(kind: Any) -> bool:
    return any(is_dataclass(each) for each in members(kind))


def members(kind: Any) -> tuple[Any, ...]:
    """Return the types of a union, or a tuple with the type if it is not a union."""
    union = typing.get_origin(kind) in (typing.Union, types.UnionType)
    return typing.get_args(kind) if union else (kind,)
