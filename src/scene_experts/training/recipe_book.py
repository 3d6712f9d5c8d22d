"""Recipes by name: this package's own, and those of other packages, which are imported when they are first needed."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from dataclasses import replace
from importlib.metadata import EntryPoint, entry_points

from scene_experts.training.config import Train

GROUP = "scene_experts.recipes"
Recipe = tuple[str, Train]
"""A sentence about the recipe, and its value."""

log: logging.Logger = logging.getLogger(__name__)


class RecipeBook(Mapping[str, Recipe]):
    """Recipes by name. A package adds its own by entry points of the group `scene_experts.recipes`, in its pyproject.toml:

        [project.entry-points."scene_experts.recipes"]
        my-method = "my_package.recipes:my_method"

    The object is a `Train` value, a pair of a sentence and a `Train` value, or a dictionary of such pairs by name. A package that cannot
    be used is left out, with one warning.
    """

    def __init__(self, own: Mapping[str, Recipe]) -> None:
        """own: recipes that are there without any import."""
        self._own = own
        self._others: dict[str, Recipe] | None = None

    def load(self) -> dict[str, Recipe]:
        """The recipes of other packages, imported on the first call. Their parts are registered from then on."""
        if self._others is None:
            self._others = {}
            for entry in entry_points(group=GROUP):
                try:
                    found = read_entry(entry)
                    if taken := [name for name in found if name in self._own or name in self._others]:
                        raise ValueError(f"there already is a recipe {taken[0]!r}")
                    self._others |= found
                except Exception as error:  # whatever another package does, our own recipes stay usable
                    where = f"{entry.name!r} ({entry.value})"
                    log.warning("cannot use the recipe %s of another package: %s; update or uninstall that package", where, error)
        return self._others

    def __getitem__(self, name: str) -> Recipe:
        return self._own[name] if name in self._own else self.load()[name]

    def __iter__(self) -> Iterator[str]:
        yield from self._own
        yield from self.load()

    def __len__(self) -> int:
        return len(self._own) + len(self.load())


def read_entry(entry: EntryPoint) -> dict[str, Recipe]:
    """The recipes that an entry point offers. Raises TypeError for another object, and whatever its import raises."""
    value = entry.load()
    recipes = value if isinstance(value, Mapping) else {entry.name: value}
    out: dict[str, Recipe] = {}
    for name, recipe in recipes.items():
        text, cfg = recipe if isinstance(recipe, tuple) and len(recipe) == 2 else (f"from {entry.value.partition(':')[0]}", recipe)
        if not isinstance(cfg, Train):
            raise TypeError(f"expected a Train value for {name!r}, found {cfg!r}")
        out[name] = (str(text), replace(cfg, recipe=name))
    return out
