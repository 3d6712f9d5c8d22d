"""Parts of a recipe, and the registry that finds a part by its name in config.json."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, Self, TypeVar

from scene_experts.core.fields import scale


@dataclasses.dataclass(frozen=True)
class Part:
    """A part of a recipe: a frozen dataclass of numbers.

    Each field is a flag on the command line, and the docstring of the field is its help text.
    config.json stores the class name of a part. Annotations of a field state its range, whether it
    is scaled and where it has an effect (`core/fields.py`). A part with relations between fields
    has a method `check(flag)`, which raises InputError. Parts of other packages must be registered
    with `register`.
    """

    changes: ClassVar[tuple[str, ...]] = ()
    """One sentence for each change, since the first release, of what the part computes with the
    same settings, a new default included. Their number is part of the names of runs and records
    with this part, so that only these are trained again."""

    def scaled(self, factor: float) -> Self:
        """Return the part for a training that is `factor` times as long: settings marked `SCALES`
        are multiplied."""
        return scale(self, factor)


P = TypeVar("P", bound=Part)
_REGISTERED: dict[str, type[Part]] = {}


def register(part: type[P]) -> type[P]:
    """Register a part by its class name, so that runs with this part can be opened again. Use it as
    a decorator:

        @register
        @dataclass(frozen=True)
        class MyGrowth(GrowAnchors): ...

    Raises TypeError if the class is not a dataclass that subclasses `Part`, and ValueError if
    another class has the same name.
    """
    if not dataclasses.is_dataclass(part) or not issubclass(part, Part):
        raise TypeError(f"expected a frozen dataclass that subclasses Part, found {part!r}")
    known = _REGISTERED.get(part.__name__, part)
    if (known.__module__, known.__qualname__) != (part.__module__, part.__qualname__):  # a reload may define the same class again
        raise ValueError(f"expected a part of a new name, found {part.__name__!r} of both {known.__module__} and {part.__module__}")
    _REGISTERED[part.__name__] = part
    return part


def extend(part: Part, kind: type[P], **numbers: Any) -> P:
    """Return a part of the class `kind`, a subclass of the class of `part`, with the numbers of
    `part` and `numbers`:

        loss = extend(recipe.loss, MyWeights, mine=0.01)

    `MyWeights(mine=0.01)` would have the defaults of the class instead of the numbers of the
    recipe.

    Raises TypeError if `kind` is no subclass, or has no field of a name.
    """
    if not issubclass(kind, type(part)):
        raise TypeError(f"expected a subclass of {type(part).__name__}, found {kind.__name__}")
    return kind(**{field.name: getattr(part, field.name) for field in dataclasses.fields(part) if field.init} | numbers)


def become(part: Part, kind: type[P]) -> P:
    """Return a part of the class `kind` that takes the place of `part`: settings of both keep their
    values."""
    kept = {field.name for field in dataclasses.fields(kind) if field.init} & {field.name for field in dataclasses.fields(part)}
    return kind(**{name: getattr(part, name) for name in kept})


def find(name: str, kind: type[P]) -> type[P] | None:
    """Return the registered subclass of `kind` with the name `name`, or None."""
    part = _REGISTERED.get(name)
    return part if part is not None and issubclass(part, kind) else None


def choices(kind: type[P]) -> dict[str, type[P]]:
    """Return the registered subclasses of `kind` that have a `name`, by that name."""
    return {str(part.name): part for part in _REGISTERED.values() if issubclass(part, kind) and hasattr(part, "name")}  # type: ignore[attr-defined]


def names_of(kind: type[Part]) -> list[str]:
    """Return the names of all registered subclasses of `kind`, in order of registration."""
    return [name for name, part in _REGISTERED.items() if issubclass(part, kind)]
