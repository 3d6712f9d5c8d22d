"""A class name says which class is meant: none is defined twice."""

import ast
from collections import defaultdict

from support.places import ROOT

SOURCE = ROOT / "src" / "scene_experts"
TWINS = {  # the name is right for both: the public class wraps the internal one, and is never used beside it
    "Camera": {"api/camera.py", "core/types.py"},
    "Capture": {"api/capture.py", "data/views.py"},
}


def test_no_class_name_is_defined_twice():
    places = defaultdict(list)
    for path in SOURCE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef):
                places[node.name].append(path.relative_to(SOURCE).as_posix())
    twice = {name: found for name, found in places.items() if len(found) > 1 and TWINS.get(name) != set(found)}
    assert twice == {}
