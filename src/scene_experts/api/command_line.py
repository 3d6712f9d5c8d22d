"""The command line that repeats a scripted training, for its config.json."""

from __future__ import annotations

import dataclasses
import re
import shlex
from pathlib import Path
from typing import Any

from scene_experts.arguments.option import Option
from scene_experts.core.fields import Chosen, flag_of, note
from scene_experts.core.parts import Part, become
from scene_experts.data.settings import Data
from scene_experts.training.config import Train
from scene_experts.training.options import TrainOptions
from scene_experts.training.recipes import RECIPES

RECORDED = ("deterministic", "stop_at", "max_memory")
"""Options of a training that its results depend on."""


def command_of(cfg: Train, data: Data, out: Path | None, options: TrainOptions) -> str:
    """`scene-experts train ...` with every number that differs from the recipe; empty where no
    command can say it."""
    if cfg.recipe not in RECIPES:
        return ""
    changed, read = changes(RECIPES[cfg.recipe][1], cfg), changes(Data(data.path), data)
    if changed is None or read is None or out is None:
        return ""
    words = ["scene-experts", "train", cfg.recipe, *words_of("data", data.path), *words_of("out", out)]
    words += [word for place, value in [*read, *changed] for word in words_of(place, value)]
    words += [word for name in RECORDED for word in words_of(name, getattr(options, name)) if getattr(options, name)]
    return shlex.join(words)


def changes(old: Any, new: Any, above: str = "") -> list[tuple[str, Any]] | None:
    """Return dotted names and values of the numbers in which two dataclasses differ, or None if a
    part is of another kind, or no flag sets one of them."""
    out = []
    for field in dataclasses.fields(new):
        was, now = getattr(old, field.name), getattr(new, field.name)
        if not dataclasses.is_dataclass(now):
            if now != was and not can_say(type(new), field.name, now):
                return None
            out += [(above + field.name, now)] if now != was else []
            continue
        if isinstance(now, Part) and type(was) is not type(now) and note(type(new), field.name, Chosen) is not None:
            out.append((above + field.name, now.name))  # type: ignore[attr-defined]
            was = become(was, type(now))
        below = changes(was, now, f"{above}{field.name}.") if type(was) is type(now) else None
        if below is None:
            return None
        out += below
    return out


def can_say(kind: type, name: str, value: Any) -> bool:
    """Whether a flag sets a field of a dataclass to a value."""
    option = note(kind, name, Option)
    words = [str(each) for each in value] if isinstance(value, tuple) else []
    return not (option is not None and option.hidden) and not any(word == "none" or is_flag(word) for word in words)


def is_flag(word: str) -> bool:
    """Whether a command takes a word for a flag."""
    return word.startswith("-") and not re.fullmatch(r"-[\d.].*", word)


def words_of(place: str, value: Any) -> list[str]:
    """The flag that sets a number."""
    if isinstance(value, bool):
        head, _, last = flag_of(place).removeprefix("--").rpartition(".")
        return [f"--{head}{'.' if head else ''}{'' if value else 'no-'}{last}"]
    if isinstance(value, tuple):
        return [flag_of(place), *(map(str, value) if value else ["none"])]
    return [f"{flag_of(place)}={value}"] if is_flag(str(value)) else [flag_of(place), str(value)]
