"""Parts of a recipe, and the registry that finds a part by its name in config.json."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
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
    same settings, a new default included. The part of a subclass has those of its bases too."""

    @classmethod
    def version(cls) -> int:
        """Return the number of `changes` of the class and its bases. It is part of the names of
        runs and records with this part, so that only these are trained again."""
        return sum(len(vars(kind).get("changes", ())) for kind in cls.__mro__)

    def scaled(self, factor: float) -> Self:
        """Return the part for a training that is `factor` times as long: settings marked `SCALES`
        are multiplied."""
        return scale(self, factor)


P = TypeVar("P", bound=Part)
_REGISTERED: dict[str, type[Part]] = {}
_LOADERS: list[Callable[[], object]] = []
RESERVED = ("type", "version")
"""Keys of a part in config.json that are no settings."""


def register(part: type[P]) -> type[P]:
    """Register a part by its class name, so that runs with this part can be opened again. Use it as
    a decorator:

        @register
        @dataclass(frozen=True)
        class MyGrowth(GrowAnchors): ...

    Raises TypeError if the class is not itself a dataclass that subclasses `Part`, if a setting has
    no default or a name in RESERVED, or if parts of its kind are chosen by a `name` and it has
    none. Raises ValueError if another class has the same class name, or the same `name` among
    those of its kind.
    """
    if not isinstance(part, type) or not issubclass(part, Part) or "__dataclass_fields__" not in vars(part):
        raise TypeError(f"expected a frozen dataclass that subclasses Part, found {part!r}; write @dataclass(frozen=True) above the class")
    for field in dataclasses.fields(part):
        if field.name in RESERVED:
            raise TypeError(
                f"expected settings with other names than {' and '.join(RESERVED)}, found {part.__name__}.{field.name}; rename it"
            )
        if field.init and field.default is field.default_factory is dataclasses.MISSING:
            raise TypeError(f"expected a default for each setting of a part, found none for {part.__name__}.{field.name}; give it one")
    if not _is_same(known := _REGISTERED.get(part.__name__, part), part):
        raise ValueError(f"expected a part of a new name, found {part.__name__!r} of both {known.__module__} and {part.__module__}")
    if any("name" in vars(kind).get("__annotations__", {}) for kind in part.__mro__):
        if not hasattr(part, "name"):
            raise TypeError(f'expected a `name` for the command line in {part.__name__}, found none; write name = "..." in the class')
        taken = choices(_kind_of(part)).get(str(part.name), part)  # type: ignore[attr-defined]
        if not _is_same(taken, part):
            raise ValueError(f"expected another `name` than {part.name!r} in {part.__name__}, found it in {taken.__name__} too; change it")  # type: ignore[attr-defined]
    _REGISTERED[part.__name__] = part
    return part


def _is_same(one: type[Part], other: type[Part]) -> bool:
    """Whether two classes are one definition: a reload may define the same class again."""
    return (one.__module__, one.__qualname__) == (other.__module__, other.__qualname__)


def _kind_of(part: type[Part]) -> type[Part]:
    """Return the base directly below `Part`: Router, Decoder, ..."""
    return next(kind for kind in reversed(part.__mro__) if issubclass(kind, Part) and kind is not Part)


def load_with(loader: Callable[[], object]) -> None:
    """Call `loader` where a part is not known: it imports packages that may register it."""
    _LOADERS.append(loader)


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
    """Return the registered subclass of `kind` with the class name `name`, or None. Packages that
    may define it are imported first (`load_with`)."""
    _load_unless(name in _REGISTERED)
    part = _REGISTERED.get(name)
    return part if part is not None and issubclass(part, kind) else None


def choice(name: str, kind: type[P]) -> type[P] | None:
    """Return the registered subclass of `kind` that `choices` has under `name`, or None, as `find`
    does."""
    _load_unless(name in choices(kind))
    return choices(kind).get(name)


def _load_unless(known: bool) -> None:
    for loader in () if known else _LOADERS:
        loader()


def choices(kind: type[P]) -> dict[str, type[P]]:
    """Return the registered subclasses of `kind` that have a `name`, by that name."""
    return {str(part.name): part for part in _REGISTERED.values() if issubclass(part, kind) and hasattr(part, "name")}  # type: ignore[attr-defined]


def names_of(kind: type[Part]) -> list[str]:
    """Return the names of all registered subclasses of `kind`, in order of registration."""
    return [name for name, part in _REGISTERED.items() if issubclass(part, kind)]
