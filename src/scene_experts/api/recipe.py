"""`recipe`: a method with its numbers, some of them changed."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from scene_experts.core.errors import InputError, nearest
from scene_experts.core.fields import Chosen, note, notes_of
from scene_experts.core.parts import Part, become, choice, choices
from scene_experts.core.plain import from_json, to_json
from scene_experts.training.config import Train, check
from scene_experts.training.recipes import RECIPES

Recipe = Train


def list_recipes() -> dict[str, str]:
    """Return the names of all recipes, with a sentence on each. Installed packages may add
    recipes."""
    return {name: text for name, (text, _) in RECIPES.items()}


def recipe(name: str | Recipe, /, **numbers: Any) -> Recipe:
    """Return a recipe with changed numbers.

    Args:
        name: One of `list_recipes()`, or a recipe to change.
        numbers: Values to change, by the names of the options of `scene-experts train RECIPE
            --help-all`: `iterations=3000`. The numbers of a part have dotted names,
            `**{"scene.voxel_size": 0.01}`, or are in a dictionary, `scene={"voxel_size": 0.01}`.
            `iterations` rescales the whole schedule: learning rates, densification and warm-up keep
            their share of the training.

    Raises:
        InputError: The recipe or a name is unknown, or a value has the wrong type or is out of
            range.
    """
    value = find_recipe(name) if isinstance(name, str) else name
    if not isinstance(value, Recipe):
        raise InputError(f"expected a recipe or its name, found {value!r}; `list_recipes()` names them all")
    for place, number in sorted(flat(numbers), key=lambda each: each[0].count(".")):  # a part before its numbers
        value = with_number(value, place.split("."), place, number, value)
    check(value)
    return value


def find_recipe(name: str) -> Recipe:
    """Return the recipe `name`. Raises InputError, with the nearest names, if it does not exist."""
    if name not in RECIPES:
        raise InputError(f"expected a recipe, found {name!r}{nearest(name, RECIPES)}; `list_recipes()` names them all")
    return RECIPES[name][1]


def flat(numbers: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted names and values of nested dictionaries."""
    for name, value in numbers.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{above}{name}.")
        else:
            yield f"{above}{name}", value


def with_number(part: Any, place: list[str], name: str, value: Any, whole: Recipe) -> Any:
    """The part of a recipe with `value` at `place` below it. Raises InputError, with the whole
    `name`, for what does not fit."""
    first, rest = place[0].replace("-", "_"), place[1:]
    if not has_number(part, first):
        raise InputError(f"the recipe {whole.recipe!r} has no {name!r}{nearest(name, names(whole))}; give the name of an option")
    new = with_number(getattr(part, first), rest, name, value, whole) if rest else fitting(part, first, name, value)
    return dataclasses.replace(part, **{first: new})


def has_number(part: Any, name: str) -> bool:
    """Whether a part of a recipe has a field of that name that can be changed."""
    fixed = ("recipe", "schedule")
    return dataclasses.is_dataclass(part) and name not in fixed and any(field.name == name for field in dataclasses.fields(part))


def fitting(part: Any, field: str, name: str, value: Any) -> Any:
    """`value` as the type of a field has it. Raises InputError for another type."""
    plain = value.item() if isinstance(value, np.generic) else value
    if isinstance(plain, str) and note(type(part), field, Chosen) is not None:
        return named_part(getattr(part, field), notes_of(type(part))[field][0], name, plain)
    kind = typing.get_type_hints(type(part))[field]
    try:
        found = from_json(kind, to_json(plain), name)
    except InputError:
        raise InputError(f"expected {name} of the type of {getattr(part, field)!r}, found {value!r}; correct the value") from None
    return plain if dataclasses.is_dataclass(plain) else found


def named_part(old: Part, kind: type[Part], name: str, wanted: str) -> Part:
    """Return the part that the command line calls `wanted`, with the settings that it shares with
    the `old` one. Raises InputError if there is none."""
    if (found := choice(wanted, kind)) is None:
        raise InputError(f"expected {name} among {', '.join(choices(kind))}, found {wanted!r}; choose one of those")
    return old if type(old) is found else become(old, found)


def names(part: Any, above: str = "") -> list[str]:
    """Dotted names of all numbers of a recipe."""
    out = []
    for field in dataclasses.fields(part):
        value = getattr(part, field.name)
        out += names(value, f"{above}{field.name}.") if dataclasses.is_dataclass(value) else [f"{above}{field.name}"]
    return [name for name in out if name not in ("recipe", "schedule")]
