"""The names and the cost of `import scene_experts`."""

import ast
import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import scene_experts as se

PUBLIC = [name for name in se.__all__ if not name.startswith("_")]


def test_the_import_is_lazy():
    code = "import sys, time; t = time.perf_counter(); import scene_experts as se; t = time.perf_counter() - t; print(t); dir(se); "
    code += "sys.exit(any(m in sys.modules for m in ('torch', 'numpy', 'rich', 'tyro')))"
    took = []
    for _ in range(3):
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
        assert done.returncode == 0, "torch, numpy, rich or tyro was imported"
        took.append(float(done.stdout))
    assert min(took) < 0.3


def test_the_lazy_names_are_those_that_type_checkers_see():
    tree = ast.parse(Path(se.__file__).read_text())
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    seen = {alias.name: node.module for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert seen == {name: f"scene_experts.{module}" for name, module in se._MODULE_OF.items()}
    assert set(se.__all__) == {*seen, "__version__"} and se.__all__ == sorted(se.__all__) and set(se.__all__) <= set(dir(se))
    assert all(getattr(se, name) is not None for name in se.__all__)
    with pytest.raises(AttributeError, match="nothing"):
        _ = se.nothing


@pytest.mark.parametrize("name", PUBLIC)
def test_every_public_name_is_documented(name):
    thing = getattr(se, name)
    if not inspect.isclass(thing):
        assert name == "Event" or thing.__doc__, name
        return
    assert thing.__doc__ and not thing.__doc__.startswith(f"{name}("), f"{name} has no docstring of its own"
    for member, value in vars(thing).items():
        if not member.startswith("_") and (callable(value) or isinstance(value, (property, classmethod))):
            assert inspect.getdoc(getattr(thing, member)), f"{name}.{member}"


@pytest.mark.parametrize("name", [name for name in PUBLIC if inspect.isclass(getattr(se, name))])
def test_every_public_field_is_documented(name):
    thing = getattr(se, name)
    if thing.__module__.startswith("scene_experts.core.errors"):
        return
    module = ast.parse(Path(inspect.getfile(thing)).read_text())
    (tree,) = (node for node in module.body if isinstance(node, ast.ClassDef) and node.name == thing.__name__)
    for node, following in zip(tree.body, [*tree.body[1:], None]):
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            said = isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant)
            assert said, f"{name}.{node.target.id} has no docstring"


def test_the_package_tells_type_checkers_that_it_is_typed():
    assert (Path(se.__file__).parent / "py.typed").is_file()
