"""Hooks of the documentation site (`make docs`): pages of the commands, and pages of files outside docs/ that its pages link to."""

from __future__ import annotations

import json
import os
import posixpath
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parent.parent
OUTSIDE = "repository"  # folder of the site for pages of files outside docs/
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)")
FENCE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
COMMANDS = "reference/commands.md"  # the page that `commands` fills
RECIPES = "reference/recipes.md"  # the page that `recipes` fills
RECIPE = "scene-experts"  # whose options stand for those of every recipe


def on_files(files: Files, config: Any) -> Files:
    """Add pages for results/, examples/ and the documents in the repository's root."""
    for path in sorted(
        [
            ROOT / "CHANGELOG.md",
            ROOT / "CONTRIBUTING.md",
            *ROOT.glob("results/**/*.md"),
            *ROOT.glob("results/**/*.png"),
            *ROOT.glob("examples/**/*.md"),
        ]
    ):
        files.append(File.generated(config, f"{OUTSIDE}/{path.relative_to(ROOT).as_posix()}", abs_src_path=str(path)))
    for path in sorted(ROOT.glob("examples/**/*.py")):
        name = path.relative_to(ROOT).as_posix()
        files.append(File.generated(config, f"{OUTSIDE}/{name}.md", content=f"# {name}\n\n```python\n{path.read_text()}```\n"))
    for path in sorted(ROOT.glob("examples/*.ipynb")):
        name = path.relative_to(ROOT).as_posix()
        files.append(File.generated(config, f"{OUTSIDE}/{name}.md", content=notebook(path)))
    return files


def notebook(path: Path) -> str:
    """Return the cells of a notebook in Markdown."""
    cells = [(cell["cell_type"], "".join(cell["source"])) for cell in json.loads(path.read_text())["cells"]]
    return "\n\n".join(text if kind == "markdown" else f"```python\n{text}\n```" for kind, text in cells) + "\n"


def on_page_content(html: str, **_: Any) -> str:
    """Make empty header cells plain cells: a screen reader would announce a header without a name."""
    return re.sub(r"<th( [^>]*)?>\s*</th>", r"<td\1></td>", html)


def on_page_markdown(markdown: str, page: Any, files: Files, **_: Any) -> str:
    """Point links between docs/ and the rest of the repository to their pages. Links to files without a page become text."""
    here = page.file.src_uri
    source = here.removeprefix(f"{OUTSIDE}/") if here.startswith(f"{OUTSIDE}/") else f"docs/{here}"

    def follow(match: re.Match[str]) -> str:
        bang, text, target = match.groups()
        path, hash_, anchor = target.partition("#")
        if not path or re.match(r"[a-z]+:", target):
            return match[0]
        found = find(posixpath.normpath(posixpath.join(posixpath.dirname(source), path)), files)
        if found is None:
            return text
        return f"{bang}[{text}]({posixpath.relpath(found, posixpath.dirname(here) or '.')}{hash_}{anchor})"

    if here == COMMANDS:
        return f"{markdown}\n\n{commands()}"
    if here == RECIPES:
        return f"{markdown}\n\n{recipes()}"
    parts, last = [], 0
    for fence in FENCE.finditer(markdown):
        text = list_arrows(fence[0]) if fence[0].startswith("```mermaid") else fence[0]
        parts += [LINK.sub(follow, markdown[last : fence.start()]), text]
        last = fence.end()
    return "".join([*parts, LINK.sub(follow, markdown[last:])])


def list_arrows(diagram: str) -> str:
    """Return a Mermaid flowchart as a table: drawing it would need a script from elsewhere."""
    rows = []
    for line in diagram.splitlines():
        left, arrow, right = line.partition("-->")
        if arrow:
            names = [re.sub(r'^\w+\["(.*)"\]$', r"\1", name.strip()) for name in (left, *right.split("&"))]
            rows.append(f"| {names[0]} | {', '.join(names[1:])} |")
    return "\n".join(["| package | imports |", "|---|---|", *rows])


def find(path: str, files: Files) -> str | None:
    """Return the page of a path of the repository, or None."""
    uri = path.removeprefix("docs/") if path.startswith("docs/") else f"{OUTSIDE}/{path}"
    return next((u for u in (uri, f"{uri}.md", f"{uri}/README.md") if files.get_file_from_path(u)), None)


def commands() -> str:
    """Return all commands in Markdown, made from their help."""
    names = re.findall(r"^  ([a-z]+)  ", help_of(), re.MULTILINE)
    parts = [f"```text\n{help_of()}```"]
    for name in names:
        words = [name, RECIPE, "--help-all"] if name == "train" else [name, "--help-all"]
        parts += [f"## {name}"]
        parts += [f"```text\n{help_of('train')}```", f"### The options of `train {RECIPE}`"] if name == "train" else []
        parts += [f"```text\n{help_of(*words)}```"]
    return "\n\n".join(parts) + "\n"


def recipes() -> str:
    """Return all recipes in Markdown, in the groups of `train --help`, each with its description."""
    code = (
        "import json, re; from scene_experts.commands.train import GROUPS; from scene_experts.training.recipes import RECIPES; "
        "left = dict(RECIPES);"
        "print(json.dumps({t: [(n, left.pop(n)[0]) for n in list(left) if re.fullmatch(p, n)] for t, p in GROUPS.items()}))"
    )
    done = run([sys.executable, "-c", code])
    parts = []
    for title, rows in json.loads(done).items():
        if rows:
            lines = [f'| <span id="{name}"></span>`{name}` | {text.replace("|", "&#124;")} |' for name, text in rows]
            parts.append("\n".join([f"## {title}", "", "| recipe | what it is |", "|---|---|", *lines]))
    return "\n\n".join(parts) + "\n"


def help_of(*words: str) -> str:
    """Return what `scene-experts WORDS --help` prints, 100 columns wide."""
    args = [*words] if "--help-all" in words else [*words, "--help"]
    return run([sys.executable, "-m", "scene_experts", *args])


def run(command: list[str]) -> str:
    """Return what a command prints, 100 columns wide."""
    environment = {**os.environ, "COLUMNS": "100", "PYTHONPATH": str(ROOT / "src")}
    return subprocess.run(command, capture_output=True, text=True, env=environment, cwd=ROOT, check=True).stdout
