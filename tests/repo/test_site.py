"""The documentation site builds: every link within it leads to a page, and every command, recipe page and public name is there."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

import scene_experts
from scene_experts.commands import COMMANDS

ROOT = Path(__file__).resolve().parents[2]


def test_every_public_name_has_an_entry():
    text = (ROOT / "docs" / "reference" / "api.md").read_text()
    named = {line.removeprefix("::: scene_experts.") for line in text.splitlines() if line.startswith(":::")}
    assert named == set(scene_experts.__all__) - {"__version__"}


def test_every_page_is_in_the_navigation():
    listed = (ROOT / "mkdocs.yml").read_text()
    pages = [path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")]
    assert not [page for page in pages if f" {page}\n" not in listed]


@pytest.mark.slow
def test_it_builds_without_a_warning(tmp_path):
    if importlib.util.find_spec("mkdocs") is None or importlib.util.find_spec("mkdocstrings") is None:
        pytest.skip("needs mkdocs-material and mkdocstrings: pip install 'scene-experts[docs]'")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    page = (tmp_path / "site" / "reference" / "commands.html").read_text()
    assert all(f'id="{name}"' in page for name in COMMANDS)
    assert "https://fonts" not in page
