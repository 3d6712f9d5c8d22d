"""The help of a command is plain text that fits its terminal."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import pytest

from scene_experts.arguments.help import columns, format_usage, page
from scene_experts.arguments.option import Option
from scene_experts.arguments.table import rows


@dataclass(frozen=True)
class Rate:
    first: float = 1.0
    """Rate at the start."""
    last: float = 0.1


@dataclass(frozen=True)
class Scene:
    """What the scene is made of. And more."""

    size: int = 3
    """Its size."""
    hidden: int = 0
    names: tuple[str, ...] = ()
    wide: bool = True
    """Make it wide."""
    rate: Rate = Rate()
    """Rate of learning."""


@dataclass(frozen=True)
class Build:
    """Build a scene, which is said here at such length that it has to be wrapped on any terminal in the world.

    A second paragraph.
    """

    run: Annotated[Path, Option(value="RUN")]
    """Run folder."""
    quality: Annotated[Literal["low", "high"], Option(short="-q")] = "low"
    """How well; low by default."""
    seed: int = 0
    scene: Scene = field(default_factory=Scene)


def shown(first: tuple[str, ...] = ()) -> str:
    return page(Build, "se build", "", rows(Build, {}), ("--run",), first)


@pytest.mark.parametrize("width", ["60", "80", "100", "200"])
def test_lines_fit_the_terminal(width, monkeypatch):
    monkeypatch.setenv("COLUMNS", width)
    assert max(map(len, shown().splitlines())) <= min(int(width), 100)


def test_all_options_in_groups(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    text = shown()
    assert text.startswith("usage: se build RUN [options]\n\nBuild a scene") and "\n\nA second paragraph." in text
    assert "-q, --quality low|high" in text and "(default: low)" not in text  # the text says it
    assert "--seed N" in text and "(default: 0)" in text
    assert "\nscene: What the scene is made of:\n" in text
    assert "--scene.wide, --scene.no-wide" in text and "(default: on)" in text
    assert "Rate of learning: rate at the start." in " ".join(text.split())
    assert text.index("--scene.rate.first") > text.index("\nscene:") and "scene.rate:" not in text  # too small for a group of its own


def test_the_first_options_alone(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    text = shown(("--seed", "--quality"))
    assert text.index("--seed") < text.index("--quality") and "--scene" not in text
    assert "se build --help-all" in text


def test_how_a_command_is_written():
    assert format_usage("se build", rows(Build, {}), ("--run",)) == "se build RUN"
    assert format_usage("se build", rows(Build, {"run": Path()}), ("--run",)) == "se build [RUN]"


def test_a_long_name_has_its_text_below():
    assert columns("  -a", "text", 80) == ["  -a".ljust(26) + "text"]
    assert columns("  --a-name-that-is-much-too-long", "text", 80) == ["  --a-name-that-is-much-too-long", " " * 26 + "text"]
