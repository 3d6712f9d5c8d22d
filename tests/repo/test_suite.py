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


def fast(function: ast.FunctionDef) -> bool:
    return not any(ast.unparse(mark) == "pytest.mark.slow" for mark in function.decorator_list)


@pytest.mark.parametrize("path", sorted((TESTS / "unit").rglob("test_*.py")), ids=lambda p: p.relative_to(TESTS).as_posix())
def test_every_unit_file_has_a_fast_test(path):
    """`make test-fast` reaches every module."""
    functions = [n for n in ast.parse(path.read_text()).body if isinstance(n, ast.FunctionDef) and n.name.startswith("test_")]
    assert any(fast(function) for function in functions)
