"""Parts of a recipe, and the registry that finds a part by the name that config.json holds."""

from __future__ import annotations

import dataclasses
from typing import Self, TypeVar


@dataclasses.dataclass(frozen=True)
class Part:
    """A part of a recipe: a frozen dataclass of numbers.

    Each field is a flag on the command line, and the field's docstring is its help. config.json keeps a part under the name of its
    class. A part of another package becomes known by `register`.
    """

    def scaled(self, factor: float) -> Self:
        """The same part in a training `factor` times as long: windows of the schedule scale. By default there are none."""
        return self

    def check(self) -> None:
        """Raises InputError, naming the flag, for invalid settings. By default every setting is valid."""


P = TypeVar("P", bound=Part)
_REGISTERED: dict[str, type[Part]] = {}


def register(part: type[P]) -> type[P]:
    """Make a part known by its class name, so that a run that uses it can be opened again. Use it as a decorator:

        @register
        @dataclass(frozen=True)
        class MyGrowth(GrowAnchors): ...

    Raises TypeError for a class that is no frozen dataclass, ValueError where another class has the name.
    """
    if not dataclasses.is_dataclass(part) or not issubclass(part, Part):
        raise TypeError(f"expected a frozen dataclass that subclasses Part, found {part!r}")
    known = _REGISTERED.get(part.__name__, part)
    if (known.__module__, known.__qualname__) != (part.__module__, part.__qualname__):  # the same class may be defined again (reload)
        raise ValueError(f"expected a part of a new name, found {part.__name__!r} of both {known.__module__} and {part.__module__}")
    _REGISTERED[part.__name__] = part
    return part


def find(name: str, kind: type[P]) -> type[P] | None:
    """The registered part called `name` that is a `kind`; None where there is none."""
    part = _REGISTERED.get(name)
    return part if part is not None and issubclass(part, kind) else None


def names_of(kind: type[Part]) -> list[str]:
    """The names of all registered parts that are a `kind`, in the order of their registration."""
    return [name for name, part in _REGISTERED.items() if issubclass(part, kind)]
