"""Imports go one way, bottom to top, as docs/architecture.md draws it. Imports for type checkers and inside functions count too."""

import ast
from pathlib import Path

import pytest

import scene_experts

SOURCE = Path(scene_experts.__file__).parent
LAYERS = [
    {"core"},
    {"native", "arguments"},
    {"geometry"},
    {"data", "render", "scene"},
    {"strategy", "sfm"},
    {"training"},
    {"evaluate", "bench"},
    {"view", "report", "reproduce"},
    {"files"},
    {"api"},
    {"making"},
    {"commands"},
    {"cli"},
    {"__main__", "__init__"},  # the package names its public API
]
RANK = {name: rank for rank, names in enumerate(LAYERS) for name in names}


def name_modules(root: Path) -> dict[str, Path]:
    """The modules of the package in the folder `root`: their dotted names below it, and their files. The package itself is `__init__`."""
    found = {}
    for path in root.rglob("*.py"):
        parts = path.relative_to(root).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" and len(parts) > 1 else parts)] = path
    return found


def find_imports(root: Path) -> dict[str, set[str]]:
    """The modules that each module of a package imports, wherever the import stands."""
    paths, found = name_modules(root), {}
    for name, path in paths.items():
        wanted: set[str] = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                wanted |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                assert not node.level, f"{path}: a relative import"
                below = {f"{node.module}.{alias.name}" for alias in node.names}
                wanted |= {full if full.partition(".")[2] in paths else node.module or "" for full in below}
        ours = {full.partition(".")[2] or "__init__" for full in wanted if full.partition(".")[0] == root.name}
        found[name] = (ours & paths.keys()) - {name}
    return found


def find_circle(edges: dict[str, set[str]]) -> list[str]:
    """One circle of a graph with its first node repeated at the end, or an empty list."""
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


IMPORTS = find_imports(SOURCE)


@pytest.mark.parametrize("package", sorted({name.partition(".")[0] for name in IMPORTS}))
def test_a_package_imports_only_from_lower_layers(package):
    assert package in RANK, f"{package} has no layer: add it to LAYERS and to docs/architecture.md"
    for name, others in IMPORTS.items():
        tops = {other.partition(".")[0] for other in others} if name.partition(".")[0] == package else set()
        wrong = {top for top in tops - {package} if RANK[top] >= RANK[package]}
        assert not wrong, f"{name} (layer {RANK[package]}) imports from its own layer or above: {wrong}"


def test_modules_form_no_circle():
    assert find_circle(IMPORTS) == []


def test_the_parts_of_a_package_form_no_circle():
    """The folders in a folder: `files.anchors` may use `files.formats`, which then does not use `files.anchors`."""
    folders = {".".join(path.relative_to(SOURCE).parts) for path in SOURCE.rglob("*") if (path / "__init__.py").is_file()}
    edges: dict[str, set[str]] = {folder: set() for folder in folders}
    for name, others in IMPORTS.items():
        for a in folders:
            beside = {b for b in folders if b.rpartition(".")[0] == a.rpartition(".")[0]} - {a}
            if name == a or name.startswith(f"{a}."):
                edges[a] |= {b for b in beside for other in others if other == b or other.startswith(f"{b}.")}
    assert find_circle(edges) == []


def test_a_circle_is_found(tmp_path):
    root = tmp_path / "pack"
    (root / "inner").mkdir(parents=True)
    (root / "__init__.py").write_text("from pack import a\n")
    (root / "inner" / "__init__.py").write_text("from pack.inner.b import thing\n")
    (root / "a.py").write_text("from pack.inner import thing\n")
    (root / "inner" / "b.py").write_text("from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import pack.c\nthing = 1\n")
    (root / "c.py").write_text("")
    assert find_circle(find_imports(root)) == []
    (root / "c.py").write_text("def late():\n    from pack import a\n")
    assert find_circle(find_imports(root)) == ["a", "inner", "inner.b", "c", "a"]
    (root / "c.py").write_text("from pack import __version__\n")
    assert find_circle(find_imports(root)) == ["__init__", "a", "inner", "inner.b", "c", "__init__"]


def test_every_source_file_has_its_test_file():
    tests = Path(__file__).parents[1]
    for path in SOURCE.rglob("*.py"):
        says_something = any(isinstance(node, (ast.FunctionDef, ast.ClassDef)) for node in ast.walk(ast.parse(path.read_text())))
        relative = path.relative_to(SOURCE)
        name = "init" if path.stem == "__init__" else path.stem
        places = (tests / "unit" / relative.parent / f"test_{name}.py", tests / "system" / f"test_{name.strip('_')}.py")
        assert not says_something or any(place.is_file() for place in places), path
