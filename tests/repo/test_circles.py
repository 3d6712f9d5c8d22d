"""Imports at module level form no circle."""

import ast
from collections.abc import Iterator
from pathlib import Path

import scene_experts

SOURCE = Path(scene_experts.__file__).parent


def module_name(path: Path, root: Path) -> str:
    """The dotted name of a file below the package folder `root`."""
    parts = (root.name, *path.relative_to(root).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def executed(body: list[ast.stmt]) -> Iterator[ast.stmt]:
    """The statements that run when the module is imported: no function bodies, nothing under TYPE_CHECKING."""
    for node in body:
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            continue
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            yield from executed(node.orelse)
            continue
        yield node
        for name in ("body", "orelse", "finalbody"):
            yield from executed(getattr(node, name, []))
        for handler in getattr(node, "handlers", []):
            yield from executed(handler.body)


def imported(path: Path, name: str, modules: set[str]) -> set[str]:
    """The modules among `modules` that the module `name` in file `path` imports by name."""
    found: set[str] = set()
    package = name if path.stem == "__init__" else name.rpartition(".")[0]
    for node in executed(ast.parse(path.read_text()).body):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) + 1 - node.level] if node.level else []
            base = ".".join([*above, *filter(None, [node.module])])
            for alias in node.names:
                inner = f"{base}.{alias.name}"
                found.add(inner if inner in modules else base)
    return (found & modules) - {name}


def graph(root: Path) -> dict[str, set[str]]:
    """The modules that each module of a package imports."""
    paths = {module_name(path, root): path for path in root.rglob("*.py")}
    return {name: imported(path, name, set(paths)) for name, path in paths.items()}


def circle(edges: dict[str, set[str]]) -> list[str]:
    """Return one circle of imports with its first module repeated at the end, or an empty list."""
    done: set[str] = set()

    def visit(name: str, path: list[str]) -> list[str]:
        if name in path:
            return [*path[path.index(name) :], name]
        if name in done:
            return []
        for following in sorted(edges[name]):
            if found := visit(following, [*path, name]):
                return found
        done.add(name)
        return []

    return next((found for name in sorted(edges) if (found := visit(name, []))), [])


def test_no_circle():
    assert circle(graph(SOURCE)) == []


def test_a_circle_is_found(tmp_path):
    root = tmp_path / "pack"
    (root / "inner").mkdir(parents=True)
    (root / "__init__.py").write_text("")
    (root / "inner" / "__init__.py").write_text("from .b import thing\n")
    (root / "a.py").write_text(
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from pack import c\nfrom pack.inner import thing\n"
    )
    (root / "inner" / "b.py").write_text("try:\n    import pack.c\nexcept ImportError:\n    pass\nthing = 1\n")
    (root / "c.py").write_text("def late():\n    from pack import a\n")
    assert circle(graph(root)) == []
    (root / "c.py").write_text("from . import a\n")
    assert circle(graph(root)) == ["pack.a", "pack.inner", "pack.inner.b", "pack.c", "pack.a"]
