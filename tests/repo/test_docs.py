"""The documents name files, functions, tests, switches and recipes that exist. Their links lead somewhere."""

import ast
import functools
import re
from pathlib import Path

import pytest

from scene_experts.arguments.table import rows as rows_of
from scene_experts.commands.evaluate import EvalCommand
from scene_experts.commands.render import RenderCommand
from scene_experts.commands.train import TrainCommand
from scene_experts.reproduce.options import ReproduceOptions
from scene_experts.training.recipes import RECIPES
from support.places import ROOT

PLACES = (ROOT / "src" / "scene_experts", ROOT / "csrc", ROOT / "tests", ROOT)
NAMED = re.compile(r"`([\w/]+\.(?:py|cpp|h))(?:: ([^`]+))?`")
FLAG = re.compile(r"--([\w.-]+)")


def read(name: str) -> str:
    return (ROOT / "docs" / name).read_text()


def rows(text: str) -> list[tuple[str, list[str]]]:
    """The rows of every table, each with the title of its section."""
    out, title = [], ""
    for line in text.splitlines():
        if line.startswith("#"):
            title = line.strip("# ")
        elif line.startswith("|") and not set(line) <= set("|- "):
            out.append((title, [cell.strip() for cell in line.strip("|").split("|")]))
    return out


def slug(title: str) -> str:
    """The anchor of a heading, as GitHub makes it."""
    return re.sub(r"[^\w -]", "", title.strip("# ").lower()).replace(" ", "-")


@pytest.mark.parametrize(
    "page", sorted(p for place in (".", "docs", "results", "results/*", "results/*/*") for p in ROOT.glob(f"{place}/*.md"))
)
def test_links_lead_somewhere(page):
    if not (ROOT / "docs" / "images").is_dir():
        pytest.skip("a source distribution leaves pictures out")
    broken = []
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        name, _, anchor = target.partition("#")
        if name.startswith(("http:", "https:")):
            continue
        file = page.parent / name if name else page
        anchors = {slug(line) for line in file.read_text().splitlines() if line.startswith("#")} if file.exists() and anchor else set()
        if not file.exists() or (anchor and anchor not in anchors):
            broken.append(target)
    assert not broken


def is_test(name: str) -> bool:
    return Path(name).name.startswith("test_")


def find(name: str) -> Path | None:
    return next((place / name for place in PLACES if (place / name).is_file()), None)


@functools.cache
def names_in(path: Path) -> frozenset[str]:
    """Functions, classes, methods and values of a Python file; the words of another file."""
    if path.suffix != ".py":
        return frozenset(re.findall(r"\w+", path.read_text()))
    out: set[str] = set()
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            out.add(node.name)
            inside = node.body if isinstance(node, ast.ClassDef) else []
            out |= {f"{node.name}.{n.name}" for n in inside if isinstance(n, ast.FunctionDef)}
        elif isinstance(node, (ast.Assign, ast.AnnAssign)):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            out |= {n.id for t in targets for n in ast.walk(t) if isinstance(n, ast.Name)}
    return frozenset(out)


@pytest.mark.parametrize("document", ["equations.md", "differences.md", "adding-a-method.md", "architecture.md", "conventions.md"])
def test_named_files_and_functions_exist(document):
    wrong = []
    for name, inside in NAMED.findall(read(document)):
        path = find(name)
        wrong += [name] if path is None else [f"{name}: {n}" for n in re.split(r", ", inside) if inside and n not in names_in(path)]
    assert not wrong


def test_every_equation_names_its_code_and_its_test():
    found = [(title, cells) for title, cells in rows(read("equations.md")) if cells[-1] != "test"]
    assert len(found) > 50
    for title, (rule, code, test) in found:
        assert NAMED.search(code) and not any(is_test(name) for name, _ in NAMED.findall(code)), (title, rule)
        assert NAMED.search(test) and all(is_test(name) for name, _ in NAMED.findall(test)), (title, rule)
    numbered = [cells[0] for title, cells in found if title.startswith("MoE-GS")]
    assert [rule[:3] for rule in numbered[:9]] == [f"({i})" for i in range(1, 10)]


@functools.cache
def every_flag() -> frozenset[str]:
    """Every option of these commands and of every recipe, without dashes, with the negations of the switches."""
    tables = [rows_of(kind, {}) for kind in (EvalCommand, RenderCommand, ReproduceOptions)]
    tables += [rows_of(TrainCommand, {"cfg": recipe}) for _, recipe in RECIPES.values()]
    return frozenset(name.lstrip("-") for table in tables for row in table for name in row.names)


def test_the_switches_of_the_differences_exist():
    quoted = re.findall(r"`([^`]+)`", read("differences.md"))
    wrong = [flag for text in quoted for flag in FLAG.findall(text) if flag not in every_flag() | {"help", "help-all"}]
    assert not wrong


@pytest.mark.parametrize("document", ["differences.md", "adding-a-method.md", "equations.md"])
def test_named_recipes_exist(document):
    named = {name for text in re.findall(r"recipes? (`[^|.;)]+`)", read(document)) for name in re.findall(r"`([\w-]+)`", text)}
    assert named <= set(RECIPES), named - set(RECIPES)


def test_every_open_question_has_a_decision():
    questions = [cells for title, cells in rows(read("differences.md")) if title.startswith("Open questions")][1:]
    numbers = [int(n) for cells in questions for n in re.findall(r"\d+", cells[0])]
    assert sorted(numbers) == list(range(1, 40))
    assert all(len(cells) == 4 and all(cells) for cells in questions)
    departures = [cells for _, cells in rows(read("differences.md")) if len(cells) == 3]
    assert len(departures) > 40 and all(len(cells) == 3 and all(cells) for cells in departures)


def prose(text: str) -> list[str]:
    """The lines of a page without code, tables and pictures. Of a link, only its text counts."""
    plain = re.sub(r"^ *```.*?^ *```", "", text, flags=re.MULTILINE | re.DOTALL)
    return [re.sub(r"\]\([^)]*\)", "]", line) for line in plain.splitlines() if not line.lstrip().startswith(("|", "!["))]


WRITTEN = sorted(p for place in (".", "docs", "docs/reference", "results", "results/tuning") for p in ROOT.glob(f"{place}/*.md"))


@pytest.mark.parametrize("page", WRITTEN, ids=lambda p: str(p.relative_to(ROOT)))
def test_prose_wraps_at_100_characters(page):
    assert [line for line in prose(page.read_text()) if len(line) > 100] == []


def test_the_front_page_is_short():
    text = (ROOT / "README.md").read_text()
    code = [line for block in re.findall(r"^```sh\n(.*?)^```", text, re.MULTILINE | re.DOTALL) for line in block.splitlines()]
    assert len(text.splitlines()) <= 70 and code and max(map(len, code)) <= 100
    assert {"make demo", "make test"} <= {" ".join(line.partition("#")[0].split()) for line in code}


def test_each_claim_of_the_front_page_has_one_link_to_its_figures():
    section = (ROOT / "README.md").read_text().partition("## What it is good at\n")[2].partition("\n## ")[0]
    claims = [" ".join(claim.split()) for claim in section.strip().removeprefix("* ").split("\n* ")]
    assert len(claims) >= 5
    for claim in claims:
        ((name, anchor),) = re.findall(r"\]\(([\w./-]+\.md)(?:#([\w-]+))?\)", claim)
        figures = re.findall(r"\d[\d.,]*\d", re.sub(r"\[.*?\]\([^)]*\)|3DGS", "", claim))
        if figures:
            parts = re.split(r"^(?=## )", (ROOT / name).read_text(), flags=re.MULTILINE)
            part = next(text for text in parts if slug(text.splitlines()[0]) == anchor)
            assert not [figure for figure in figures if not re.search(rf"(?<![\d.]){re.escape(figure)}(?![\d.]*\d)", part)], claim


def test_the_shipped_captures_are_small():
    size = {folder.name: sum(path.stat().st_size for path in folder.rglob("*")) for folder in (ROOT / "demo").iterdir()}
    assert size["banana"] <= 8_000_000
    assert all((ROOT / "demo" / name / "ATTRIBUTION.txt").is_file() for name in size)
