"""Imports go one way, bottom to top, as docs/architecture.md draws it."""

import ast
from pathlib import Path

import pytest

import scene_experts

SOURCE = Path(scene_experts.__file__).parent
LAYERS = [
    {"core", "native", "__init__"},
    {"arguments"},
    {"geometry"},
    {"data", "render", "scene"},
    {"strategy"},
    {"training", "recipes"},
    {"evaluate", "files", "report", "reproduce", "view", "bench", "sfm"},
    {"api"},
    {"cli", "commands", "__main__"},
]
RANK = {name: rank for rank, names in enumerate(LAYERS) for name in names}


def part(module: str) -> str:
    return module.split(".")[1] if "." in module else "__init__"


def imported(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("scene_experts"):
            found |= {f"{node.module}.{a.name}" for a in node.names} if node.module == "scene_experts" else {node.module}
        elif isinstance(node, ast.Import):
            found |= {a.name for a in node.names if a.name.startswith("scene_experts")}
    return found


FACE = SOURCE / "__init__.py"  # names the public API for type checkers, and imports it when it is used (test_init.py)


@pytest.mark.parametrize("path", sorted({*SOURCE.rglob("*.py")} - {FACE}), ids=lambda p: str(p.relative_to(SOURCE)))
def test_a_file_imports_its_own_layer_or_lower(path):
    relative = path.relative_to(SOURCE)
    me = relative.parts[0] if len(relative.parts) > 1 else path.stem
    assert me in RANK, f"{me} has no layer: add it to LAYERS and to docs/architecture.md"
    wrong = {m for m in imported(path) if part(m) in RANK and RANK[part(m)] > RANK[me]}
    assert not wrong, f"{relative} (layer {RANK[me]}) imports from above: {wrong}"


def test_every_source_file_has_its_test_file():
    tests = Path(__file__).parents[1]
    for path in SOURCE.rglob("*.py"):
        says_something = any(isinstance(node, (ast.FunctionDef, ast.ClassDef)) for node in ast.walk(ast.parse(path.read_text())))
        relative = path.relative_to(SOURCE)
        name = "init" if path.stem == "__init__" else path.stem
        places = (tests / "unit" / relative.parent / f"test_{name}.py", tests / "system" / f"test_{name.strip('_')}.py")
        assert not says_something or any(place.is_file() for place in places), path
