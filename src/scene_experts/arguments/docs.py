"""The docstrings of a dataclass and of its fields, read from its source: a string below a field says what the field is."""

from __future__ import annotations

import ast
import functools
import inspect
import itertools


def of_field(kind: type, name: str) -> str:
    """What the string below a field says, on one line; empty where there is none."""
    return next((found for owner in kind.__mro__ if (found := _fields(owner).get(name))), "")


def of_class(kind: type) -> str:
    """The docstring of a dataclass; empty where dataclass made one up."""
    text = inspect.cleandoc(kind.__doc__ or "")
    return "" if text.startswith(f"{kind.__name__}(") else text


def title(kind: type) -> str:
    """The first sentence of a dataclass's docstring."""
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
    except (OSError, TypeError):  # no source: the help has names and defaults alone
        return []
    return [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.ClassDef)]
