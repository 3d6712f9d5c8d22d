"""What a field of a dataclass says about its setting beside its type and default, as annotations:
which numbers it may have (`Range`), whether it grows with the training (`SCALES`), and where it has
an effect (`Needs`, `With`).

    warmup: Annotated[int, Range(0), SCALES] = 1500

Checks, scaled schedules, help texts and warnings are derived from these; methods remain for
relations between fields.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import typing
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, TypeVar

from scene_experts.core.errors import InputError

T = TypeVar("T")
Flag = Callable[[str], str]
"""Maps the name of a field to its flag, for messages; an empty name to the flag of the dataclass
itself."""


@dataclass(frozen=True)
class Range:
    """The numbers that a setting, or each number of a tuple, may have: from `low` to `high`, which
    both belong to it."""

    low: float | None = None
    high: float | None = None
    above: float | None = None
    """Only numbers above this one."""
    below: float | None = None
    """Only numbers below this one."""

    @property
    def two_sided(self) -> bool:
        return (self.low is not None or self.above is not None) and (self.high is not None or self.below is not None)

    def too_small(self, value: float) -> bool:
        """Whether `value` is below the range."""
        return (self.low is not None and value < self.low) or (self.above is not None and value <= self.above)

    def too_large(self, value: float) -> bool:
        """Whether `value` is above the range."""
        return (self.high is not None and value > self.high) or (self.below is not None and value >= self.below)

    def __str__(self) -> str:
        """The range in words, for example "of at least 1" or "from 0 to below 1"."""
        low = "" if self.low is None else f"from {self.low:,}"
        low = low if self.above is None else f"above {self.above:,}"
        high = "" if self.high is None else f"{self.high:,}"
        high = high if self.below is None else f"below {self.below:,}"
        if not high:
            return low.replace("from", "of at least")
        if self.below is None and not low.startswith("from"):
            high = f"at most {high}"
        return f"{low} to {high}" if low.startswith("from") else f"{low} and {high}" if low else high


@dataclass(frozen=True)
class Scales:
    """Marks iterations that grow with the length of a training, rounded, but not below `least`."""

    least: int = 0


@dataclass(frozen=True)
class Chosen:
    """Marks a part that the command line chooses by its `name`: `--scene.decoder.router margin`."""


@dataclass(frozen=True)
class Needs:
    """Marks a setting, or a part, that has an effect only on scenes with `what`
    (`SceneConfig.has`)."""

    what: str


@dataclass(frozen=True)
class With:
    """Marks a setting that has an effect only where one of the settings `names` beside it is not
    `off`."""

    names: tuple[str, ...]
    off: float = 0

    def acts_in(self, part: Any) -> bool:
        """Whether the setting has an effect in `part`, which it is a field of."""
        return any(getattr(part, name) != self.off for name in self.names)


@dataclass(frozen=True)
class Pace:
    """Marks how fast something changes that no gradient moves; 0 stops it. Trainings of blocks stop
    it, so that what all anchors share stays equal in all of them."""


SCALES = Scales()
CHOSEN = Chosen()
PACE = Pace()
Share = Annotated[float, Range(0, 1)]
NotNegative = Annotated[float, Range(0)]
Positive = Annotated[float, Range(above=0)]
Count = Annotated[int, Range(1)]
CountOrNone = Annotated[int, Range(0)]
"""A number of things where 0 has a meaning of its own."""


@functools.cache
def notes_of(kind: type) -> dict[str, tuple[Any, tuple[Any, ...]]]:
    """Return the type and the annotations of each field of a dataclass, by name."""
    out = {}
    for name, hint in typing.get_type_hints(kind, include_extras=True).items():
        inner, *notes = typing.get_args(hint) if typing.get_origin(hint) is Annotated else (hint,)
        out[name] = (inner, tuple(notes))
    return {f.name: out[f.name] for f in dataclasses.fields(kind)}


def note(kind: type, name: str, of: type[T]) -> T | None:
    """Return the annotation of a class of a field, or None."""
    return next((each for each in notes_of(kind)[name][1] if isinstance(each, of)), None)


def check_value(owner: type, name: str, value: Any, flag: str) -> None:
    """Raise InputError, which names the flag, if `value` is not finite, not in the `Range` or not
    among the words of the field `name` of `owner`."""
    limits, many = note(owner, name, Range), value if isinstance(value, tuple) else (value,)
    if words := _words(notes_of(owner)[name][0]):
        for each in many:
            if each is not None and each not in words:
                raise InputError(f"expected {flag} among {', '.join(map(str, words))}, found {each!r}; choose one of those")
    for each in many:
        if isinstance(each, float) and not math.isfinite(each):
            raise InputError(f"expected {flag} as a finite number, found {each}; correct it or leave it out")
    if limits is None:
        return
    for each in many:
        small = each is not None and limits.too_small(each)
        if small or (each is not None and limits.too_large(each)):
            raise InputError(f"expected {flag} {limits}, found {each}; give a {'larger' if small else 'smaller'} number or leave it out")


def check_fields(value: Any, place: str = "") -> None:
    """Check the settings of a dataclass and of all dataclasses in it: ranges, words, and their
    `check(flag)`, for relations.

    place: Dotted path of `value`, for the flags in messages: "scene.decoder".

    Raises InputError, which names the flag, for the first setting that is invalid.
    """
    flag: Flag = lambda name: flag_of(".".join(part for part in (place, name) if part))  # noqa: E731
    for name, inner in _fields(value):
        if dataclasses.is_dataclass(inner):
            check_fields(inner, f"{place}.{name}".lstrip("."))
        else:
            check_value(type(value), name, inner, flag(name))
    if hasattr(value, "check"):
        value.check(flag)


def flag_of(place: str) -> str:
    """Return the flag of a dotted path, for example --scene.voxel-size."""
    return f"--{place.replace('_', '-')}"


def scale(value: T, factor: float) -> T:
    """Return a dataclass whose settings marked `SCALES`, and those of the dataclasses in it, are
    multiplied by `factor`."""
    changes: dict[str, Any] = {}
    for name, inner in _fields(value):
        mark = note(type(value), name, Scales)
        if dataclasses.is_dataclass(inner):
            own = getattr(inner, "scaled", None)
            changes[name] = scale(inner, factor) if own is None else own(factor)
        elif mark is not None and isinstance(inner, tuple):
            changes[name] = tuple(max(mark.least, round(each * factor)) for each in inner)
        elif mark is not None and inner is not None:
            changes[name] = max(mark.least, round(inner * factor))
    return replace(value, **changes) if changes else value  # type: ignore[type-var]


def changed_without(value: Any, has: frozenset[str], usual: Any = None, place: str = "") -> Iterator[str]:
    """Yield the dotted paths of settings that need what is not in `has`, or act only with others that
    are off, and that have neither the default of their dataclass nor the value in `usual`: the same
    settings of a recipe, or None."""
    usual = usual if type(usual) is type(value) else None
    for field in dataclasses.fields(value):
        inner, here = getattr(value, field.name), f"{place}.{field.name}".lstrip(".")
        need, beside = note(type(value), field.name, Needs), note(type(value), field.name, With)
        idle = (need is not None and need.what not in has) or (beside is not None and not beside.acts_in(value))
        if idle and inner != default_of(field) and (usual is None or inner != getattr(usual, field.name)):
            yield here
        elif dataclasses.is_dataclass(inner) and not idle:
            yield from changed_without(inner, has, getattr(usual, field.name, None), here)


def marked(value: Any, mark: type, place: str = "") -> Iterator[str]:
    """Yield the dotted paths of settings that have an annotation of the class `mark`."""
    for name, inner in _fields(value):
        here = f"{place}.{name}".lstrip(".")
        if dataclasses.is_dataclass(inner):
            yield from marked(inner, mark, here)
        elif note(type(value), name, mark) is not None:
            yield here


def default_of(field: dataclasses.Field[Any]) -> Any:
    """Return the default of a field; dataclasses.MISSING without one."""
    return field.default if field.default_factory is dataclasses.MISSING else field.default_factory()


def _fields(value: Any) -> list[tuple[str, Any]]:
    return [(field.name, getattr(value, field.name)) for field in dataclasses.fields(value)]


def _words(kind: Any) -> tuple[Any, ...]:
    """Return the words of a Literal, also one that may be None or repeat in a tuple; empty for
    other types."""
    if typing.get_origin(kind) is Literal:
        return typing.get_args(kind)
    return next((words for each in typing.get_args(kind) if (words := _words(each))), ())
