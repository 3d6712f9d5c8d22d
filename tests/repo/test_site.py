"""The documentation site builds: every link within it leads to a page, and every command, recipe page and public name is there."""

import importlib.util
import shutil
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from urllib.request import urlopen

import pytest

import scene_experts
from scene_experts.commands import COMMANDS
from scene_experts.training.recipes import RECIPES

ROOT = Path(__file__).resolve().parents[2]


def test_every_public_name_has_an_entry():
    text = (ROOT / "docs" / "reference" / "api.md").read_text()
    named = {line.removeprefix("::: scene_experts.") for line in text.splitlines() if line.startswith(":::")}
    assert named == set(scene_experts.__all__) - {"__version__"}


def test_every_page_is_in_the_navigation():
    listed = (ROOT / "mkdocs.yml").read_text()
    pages = [path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")]
    assert not [page for page in pages if f" {page}\n" not in listed]


def load_checker(name="check_site"):
    """A module of tools/."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "tools" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)  # type: ignore[arg-type]
    spec.loader.exec_module(module)  # type: ignore[union-attr]
    return module


@pytest.mark.slow
def test_it_builds_without_a_warning(tmp_path):
    if importlib.util.find_spec("mkdocs") is None or importlib.util.find_spec("mkdocstrings") is None:
        pytest.skip("needs mkdocs-material and mkdocstrings: pip install 'scene-experts[docs]'")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    site = load_checker()
    pages = site.read_site(tmp_path / "site")
    reached = {path for path, _ in site.count_clicks(pages)}
    for page, names in {
        "reference/commands.html": COMMANDS,
        "reference/recipes.html": RECIPES,
        "reference/api.html": [f"scene_experts.{name}" for name in scene_experts.__all__ if name != "__version__"],
    }.items():
        assert page in reached and set(names) <= pages[page].ids, set(names) - pages[page].ids
    assert not list(site.find_dead(tmp_path / "site", pages))
    assert (tmp_path / "site" / "search" / "search_index.js").is_file()  # search works from disk


def test_dead_links_and_distant_pages_are_found(tmp_path):
    site = load_checker()
    text = {
        "index.html": '<a href="a/b.html#x">b</a> <a href="gone.html">gone</a> <a href="https://x.org">far</a>',
        "a/b.html": '<h2 id="x"></h2> <a href="../c.html">c</a> <a href="#y">y</a> <img src="https://x.org/i.png">',
        "c.html": '<a href="d.html">d</a>',
        "d.html": "",
    }
    for name, body in text.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(body)
    pages = site.read_site(tmp_path)
    assert sorted(site.find_dead(tmp_path, pages)) == [
        "a/b.html loads https://x.org/i.png", "a/b.html: #y has no such anchor", "index.html: gone.html leads nowhere",
    ]  # fmt: skip
    assert {path for path, _ in site.count_clicks(pages)} >= {"c.html"} and "d.html" not in {path for path, _ in site.count_clicks(pages)}


def test_a_folder_is_served_and_stands_for_its_pages(tmp_path):
    (tmp_path / "a").mkdir()
    for name in ("b.html", "a/c d.html", "a/d.txt"):
        (tmp_path / name).write_text(name)
    pages = load_checker("check_pages")
    with ExitStack() as stack:
        first, second = pages.find_addresses(tmp_path, stack)
        assert urlopen(first, timeout=10).read() == b"a/c d.html" and second.endswith("/b.html")
        assert pages.find_addresses(tmp_path / "b.html", stack) == [(tmp_path / "b.html").as_uri()]


@pytest.mark.slow
@pytest.mark.foreign
def test_pages_that_people_cannot_read_are_found(tmp_path):
    pytest.importorskip("playwright")
    pytest.importorskip("axe_playwright_python")
    pages = load_checker("check_pages")
    if not any(shutil.which(name) for name in pages.BROWSERS):
        pytest.skip("no Chromium on this machine")
    bad = tmp_path / "bad.html"
    bad.write_text(
        '<!doctype html><html lang="en"><title>a</title><main><h1>a</h1><img src="data:,"></main><script>undefined_name()</script></html>'
    )
    command = [sys.executable, str(ROOT / "tools" / "check_pages.py")]
    done = subprocess.run([*command, str(bad)], capture_output=True, text=True, timeout=60)
    assert done.returncode == 1 and "image-alt" in done.stdout and "undefined_name" in done.stdout, done.stdout + done.stderr
    bad.write_text('<!doctype html><html lang="en"><title>a</title><main><h1>a</h1></main></html>')
    done = subprocess.run([*command, str(bad)], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr
