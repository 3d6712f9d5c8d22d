"""The picture of docs/architecture.md shows the packages that exist and the imports between them."""

import ast
import re
from collections import defaultdict
from itertools import product

from support.places import ROOT

PAGE = (ROOT / "docs" / "architecture.md").read_text()
PICTURE = PAGE.partition("```mermaid")[2].partition("```")[0]
SOURCE = ROOT / "src" / "scene_experts"


def nodes() -> dict[str, str]:
    """The node of every package and module. A node stands for its package and for the modules that its label names."""
    found = {}
    for name, label in re.findall(r"(\w+)\[\"([^\"]+)\"\]", PICTURE):
        found |= {part.strip().removesuffix(".py"): name for part in label.split(",")}
    plain = re.sub(r"\[[^\]]*\]", "", PICTURE)
    return {name: name for line in plain.splitlines() if "-->" in line for name in re.findall(r"\w+", line)} | found


def arrows() -> dict[str, set[str]]:
    found = defaultdict(set)
    for line in re.sub(r"\[[^\]]*\]", "", PICTURE).splitlines():
        left, arrow, right = line.partition("-->")
        if arrow:
            for a, b in product(re.findall(r"\w+", left), re.findall(r"\w+", right)):
                found[a].add(b)
    return found


def imports() -> dict[str, set[str]]:
    """The imports between nodes, at the top of a file or inside a function. The package itself only names its API."""
    found, node_of = defaultdict(set), nodes() | {"__main__": nodes()["cli"]}
    for path in SOURCE.rglob("*.py"):
        relative = path.relative_to(SOURCE)
        here = node_of.get(relative.parts[0] if len(relative.parts) > 1 else path.stem)
        for node in ast.walk(ast.parse(path.read_text())):
            modules = []
            if isinstance(node, ast.ImportFrom) and node.module:
                modules = [f"{node.module}.{alias.name}" for alias in node.names]
            elif isinstance(node, ast.Import):
                modules = [alias.name for alias in node.names]
            for module in modules:
                there = node_of.get(module.split(".")[1]) if module.startswith("scene_experts.") else None
                if here and there and there != here:
                    found[here].add(there)
    return found


def reachable(graph: dict[str, set[str]], start: str) -> set[str]:
    seen, todo = set(), [start]
    while todo:
        for name in graph.get(todo.pop(), set()) - seen:
            seen.add(name)
            todo.append(name)
    return seen


def test_the_nodes_are_the_packages():
    packages = {p.name for p in SOURCE.iterdir() if (p / "__init__.py").is_file()}
    modules = {p.stem for p in SOURCE.glob("*.py")} - {"__init__", "__main__"}
    assert nodes().keys() == packages | modules
    described = set(re.findall(r"^\*\*(\w+)\*\*", PAGE, re.MULTILINE))
    assert described == set(nodes().values())


def test_the_arrows_are_the_imports():
    drawn, real = arrows(), imports()
    assert not [(a, b) for a in drawn for b in drawn[a] if b not in real[a]], "arrows without an import"
    assert not [(a, b) for a in real for b in real[a] if b not in reachable(drawn, a)], "imports without an arrow"
    assert not [a for a in drawn if a in reachable(drawn, a)], "a circle"
