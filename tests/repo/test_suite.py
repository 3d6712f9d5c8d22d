"""The rules that the test files keep."""

import ast

import pytest

from support.places import TESTS

FILES = sorted(TESTS.rglob("*.py"))


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.relative_to(TESTS).as_posix())
def test_a_test_file_imports_no_other_and_leaves_the_path_alone(path):
    """Builders that several files need are in tests/support or in a conftest.py."""
    text = path.read_text()
    modules = [node.module for node in ast.walk(ast.parse(text)) if isinstance(node, ast.ImportFrom) and node.module]
    modules += [alias.name for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Import) for alias in node.names]
    assert not [m for m in modules if m.split(".")[0] in ("unit", "system", "repo", "tests") or ".test_" in m or m.startswith("test_")]
    changed = [
        ast.unparse(node)
        for node in ast.walk(ast.parse(text))
        if isinstance(node, (ast.Call, ast.Assign, ast.AugAssign)) and ast.unparse(node).startswith("sys.path")
    ]
    assert not changed
