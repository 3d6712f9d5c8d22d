"""Outside `scene/`, code reads what a scene, a part or a strategy states; it never asks for its class or its kind's name."""

import ast
import functools
import re
from pathlib import Path

import pytest

import scene_experts

SOURCE = Path(scene_experts.__file__).parent
OWNERS = ("scene", "strategy")  # the packages whose classes nobody else asks for
PART = re.compile(r"\b(scene|growth|strategy|decoder|select|heads?|rates|optimizer)(\]|\b)[^.(]*$")  # what an expression ends with


@functools.cache
def classes() -> set[str]:
    """Names of the classes in the packages that own them."""
    trees = [ast.parse(path.read_text()) for owner in OWNERS for path in (SOURCE / owner).rglob("*.py")]
    return {node.name for tree in trees for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}


def is_question(node: ast.AST, known: set[str]) -> bool:
    """Whether a node asks for the class, the attributes or the family's name of a scene, a part or a strategy."""
    if isinstance(node, ast.MatchClass):
        return ast.unparse(node.cls).split(".")[-1] in known
    if isinstance(node, ast.Compare):
        sides = [node.left, *node.comparators]
        family = any(isinstance(side, ast.Attribute) and side.attr == "family" for side in sides)
        plain = any(isinstance(side, ast.Constant) for side in sides)
        return (family and plain) or any(re.search(r"\.meta\(\)$", ast.unparse(side)) for side in node.comparators)
    if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.args):
        return False
    if node.func.id in ("isinstance", "issubclass") and len(node.args) == 2:
        return any(name in known for name in re.findall(r"\w+", ast.unparse(node.args[1])))
    return node.func.id in ("type", "hasattr", "getattr") and bool(PART.search(ast.unparse(node.args[0])))


def questions(text: str) -> list[int]:
    """Lines of a source file that ask."""
    known = classes()
    return [getattr(node, "lineno", 0) for node in ast.walk(ast.parse(text)) if is_question(node, known)]


@pytest.mark.parametrize(
    ("text", "asks"),
    [
        ("isinstance(run.scene, AnchorScene)", True),
        ("isinstance(cfg.growth, (SplitClone, MCMC))", True),
        ("isinstance(value, dict)", False),
        ("type(run.scene)", True),
        ("getattr(cfg.scene, 'decoder', None)", True),
        ("hasattr(scene, 'codes')", True),
        ("getattr(training, name)", False),
        ("scene.traits.family == 'anchors'", True),
        ("cfg.rates.family != cfg.scene.family", False),
        ("'voxel' in scene.meta()", True),
        ("match scene:\n    case GaussianScene():\n        pass", True),
    ],
)
def test_what_counts_as_a_question(text, asks):
    assert bool(questions(text)) == asks


def test_nobody_asks_for_the_class_of_a_scene():
    found = {}
    for path in SOURCE.rglob("*.py"):
        place = path.relative_to(SOURCE).as_posix()
        if not place.startswith("scene/") and (lines := questions(path.read_text())):
            found[place] = lines
    assert not found
