"""Recipes by name: those of this package and those of other packages, which are imported on first use."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from dataclasses import replace
from importlib.metadata import EntryPoint, entry_points

from scene_experts.training.config import Train

GROUP = "scene_experts.recipes"
Recipe = tuple[str, Train]
"""A one-sentence description of the recipe, and its value."""

log: logging.Logger = logging.getLogger(__name__)


class RecipeBook(Mapping[str, Recipe]):
    """Recipes by name. Other packages add recipes with entry points of the group `scene_experts.recipes` in their pyproject.toml:

        [project.entry-points."scene_experts.recipes"]
        my-method = "my_package.recipes:my_method"

    The object is a `Train` value, a pair of a description and a `Train` value, or a dictionary of these by name. Packages that
    cannot be loaded are skipped with one warning.
    """

    def __init__(self, own: Mapping[str, Recipe]) -> None:
        """Create the book.

        Args:
            own: Recipes that are available without imports.
        """
        self._own = own
        self._others: dict[str, Recipe] | None = None

    def load(self) -> dict[str, Recipe]:
        """Return the recipes of other packages. The first call imports these packages, which also registers their parts."""
        if self._others is None:
            self._others = {}
            for entry in entry_points(group=GROUP):
                try:
                    found = read_entry(entry)
                    if taken := [name for name in found if name in self._own or name in self._others]:
                        raise ValueError(f"there already is a recipe {taken[0]!r}")
                    self._others |= found
                except Exception as error:  # an error in another package must not affect our own recipes
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
    """Return the recipes of an entry point. Raises TypeError for an object of another type. Errors of the import are passed on."""
    value = entry.load()
    recipes = value if isinstance(value, Mapping) else {entry.name: value}
    out: dict[str, Recipe] = {}
    for name, recipe in recipes.items():
        text, cfg = recipe if isinstance(recipe, tuple) and len(recipe) == 2 else (f"from {entry.value.partition(':')[0]}", recipe)
        if not isinstance(cfg, Train):
            raise TypeError(f"expected a Train value for {name!r}, found {cfg!r}")
        out[name] = (str(text), replace(cfg, recipe=name))
    return out
