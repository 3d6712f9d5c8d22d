"""Read the docstrings of a dataclass and its fields from the source. The docstring of a field is
the string below it."""

from __future__ import annotations

import ast
import dataclasses
import functools
import inspect
import itertools
import textwrap

FIELDS = "\n\nFields:\n"
"""Before what `explain` adds."""


def of_field(kind: type, name: str) -> str:
    """Return the docstring of a field on one line, or an empty string."""
    return next((found for owner in kind.__mro__ if (found := _fields(owner).get(name))), "")


def of_class(kind: type) -> str:
    """Return the docstring of a dataclass, or an empty string if `dataclass` generated it."""
    text = inspect.cleandoc(kind.__doc__ or "").partition(FIELDS)[0]
    return "" if text.startswith(f"{kind.__name__}(") else text


def explain(kind: object) -> None:
    """Add the docstrings of its fields to that of a dataclass, for `help`."""
    if not isinstance(kind, type) or not dataclasses.is_dataclass(kind):
        return
    texts = {field.name: of_field(kind, field.name) for field in dataclasses.fields(kind)}
    lines = [
        textwrap.fill(f"{name}: {text}", 88, initial_indent="    ", subsequent_indent="        ") for name, text in texts.items() if text
    ]
    if lines:
        kind.__doc__ = of_class(kind) + FIELDS + "\n".join(lines)


def title(kind: type) -> str:
    """Return the first sentence of the docstring of a dataclass."""
    return " ".join(of_class(kind).partition("\n\n")[0].split()).partition(". ")[0].removesuffix(".")


@functools.cache
def _fields(kind: type) -> dict[str, str]:
    found = next((node for node in _classes(inspect.getmodule(kind)) if node.name == kind.__name__), None)
    body = found.body if found else []
    out = {}
    for field, below in itertools.pairwise(body):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(below, ast.Expr):
            value = below.value
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                out[field.target.id] = " ".join(value.value.split())
    return out


@functools.cache
def _classes(module: object) -> list[ast.ClassDef]:
    try:
        source = inspect.getsource(module)  # type: ignore[arg-type]
    except (OSError, TypeError):  # without source, the help shows only names and defaults
        return []
    return [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.ClassDef)]
