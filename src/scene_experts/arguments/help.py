"""Format the help of a command as plain text: its usage, its description and its options in
groups."""

from __future__ import annotations

import shutil
import textwrap
from collections.abc import Sequence
from dataclasses import fields

from scene_experts.arguments import docs
from scene_experts.arguments.table import Row
from scene_experts.arguments.values import format_value, list_choices, placeholder
from scene_experts.core.fields import Range, note

INDENT = 2
COLUMN = 26  # column where the text of an option starts
SMALL = 3  # dataclasses with at most this many options are shown in the enclosing group


def page(kind: type, name: str, about: str, table: Sequence[Row], positional: Sequence[str], first: Sequence[str]) -> str:
    """Return the help of the command `name`. `first` lists the options to show in order; if it is
    empty, all are shown in groups."""
    width = page_width()
    by_flag = {row.flag: row for row in table}
    words = [by_flag[flag] for flag in positional]
    shown = [by_flag[flag] for flag in first] or [row for row in table if row not in words]
    usage = f"usage: {format_usage(name, table, positional)}" + (" [options]" if shown else "")
    parts = [
        textwrap.fill(usage, width, subsequent_indent=" " * 7, break_on_hyphens=False),
        paragraphs(about or docs.of_class(kind), width),
    ]
    if words:
        parts.append("\n".join(["Arguments:", *(line for row in words for line in entry(row, width, word=True))]))
    if first:
        parts.append("\n".join(["Options:", *(line for row in shown for line in entry(row, width))]))
        parts.append(f"`{name} --help-all` shows all {len(table) - len(words)} options.")
    else:
        parts += [group(title, rows, width) for title, rows in groups(kind, shown)]
    return "\n\n".join(part for part in parts if part)


def page_width() -> int:
    """Return the width of the terminal in columns, limited to 60 to 100."""
    return max(60, min(shutil.get_terminal_size().columns, 100))


def format_usage(name: str, table: Sequence[Row], positional: Sequence[str]) -> str:
    """Return the usage of a command with its positional and required options, for example
    "scene-experts info CAPTURE"."""
    by_flag = {row.flag: row for row in table}
    first = [by_flag[flag] for flag in positional]
    words = [text if row.required else f"[{text}]" for row in first if (text := stands_for(row))]
    words += [f"{row.flag} {stands_for(row)}" for row in table if row.required and row not in first]
    return " ".join([name, *words])


def stands_for(row: Row) -> str:
    """Return the placeholder of an option's value, for example CAPTURE."""
    text = placeholder(row.kind, row.option.value)
    return text.removesuffix(" ...") if row.option.repeat else text


def paragraphs(text: str, width: int) -> str:
    """Wrap paragraphs to `width`. Paragraphs with indented lines, such as lists, are not
    changed."""
    return "\n\n".join(part if "\n " in part else wrap(part, width) for part in text.strip().split("\n\n"))


def wrap(text: str, width: int, indent: int = 0) -> str:
    space = " " * indent
    return textwrap.fill(
        " ".join(text.split()), width, initial_indent=space, subsequent_indent=space, break_on_hyphens=False, break_long_words=False
    )


def groups(kind: type, shown: Sequence[Row]) -> list[tuple[str, list[Row]]]:
    """Group rows by the dataclass that declares them. Rows of a small dataclass belong to the
    enclosing dataclass."""
    out: dict[tuple[str, type | None], list[Row]] = {}
    for row in shown:
        out.setdefault(_group(row), []).append(row)
    titles = []
    for (prefix, owner), rows in sorted(out.items(), key=lambda item: bool(item[0][0])):  # nested dataclasses come last
        name, text = prefix.removesuffix("."), docs.title(owner) if owner and owner is not kind else ""
        titles.append((f"{name}: {text}" if name and text else name or text or "Options", rows))
    return titles


def _prefix(row: Row) -> str:
    before, dot, _ = row.flag.removeprefix("--").rpartition(".")
    return before + dot


def _is_small(row: Row) -> bool:
    """Whether the dataclass of a row is too small for its own heading."""
    return "." in _prefix(row)[:-1] and len(fields(row.owner)) <= SMALL


def _group(row: Row) -> tuple[str, type | None]:
    if row.within and _is_small(row):
        return _prefix(row)[:-1].rpartition(".")[0] + ".", row.within[0]
    return _prefix(row), row.owner


def group(title: str, rows: Sequence[Row], width: int) -> str:
    return "\n".join([wrap(f"{title}:", width), *(line for row in rows for line in entry(row, width))])


def entry(row: Row, width: int, word: bool = False) -> list[str]:
    """Return the lines of one option: its name, with its description beside or below it."""
    switch = row.negative if row.default is True else ""  # shown because the default is on
    names = ", ".join(name for name in (row.option.short, row.flag, switch) if name)
    return columns(" " * INDENT + (stands_for(row) if word else f"{names} {stands_for(row)}".rstrip()), describe(row), width)


def columns(left: str, text: str, width: int | None = None) -> list[str]:
    """Return the lines of a name with its text in a second column. The text starts below a long
    name."""
    lines = textwrap.wrap(text, (width or page_width()) - COLUMN, break_on_hyphens=False, break_long_words=False)
    if lines and len(left) + 2 <= COLUMN:
        left, lines = left.ljust(COLUMN) + lines[0], lines[1:]
    return [left, *(" " * COLUMN + line for line in lines)]


def describe(row: Row) -> str:
    """Return the description of an option, with its default if the text does not contain it."""
    text = docs.of_field(row.owner, row.place[-1])
    if text and row.within and _is_small(row):
        above = docs.of_field(*row.within).partition(". ")[0].removesuffix(".")
        text = f"{above}: {text[0].lower()}{text[1:]}" if above else text
    if row.part is not None:
        text = " ".join([text, *(f"{name}: {docs.title(kind)}." for name, kind in row.parts.items())])
    elif words := list_choices(row.kind):
        text = f"{text} One of {words}.".strip()
    limits = note(row.owner, row.place[-1], Range)
    inside = str(limits).removeprefix("of ") if limits is not None and limits.two_sided else ""
    plain = row.required or row.default is None or row.default is False or row.default == ()
    default = "" if plain or "default" in text else f"default: {'on' if row.default is True else format_value(row.default)}"
    notes = "; ".join(filter(None, (inside, default)))
    return f"{text} ({notes})".strip() if notes else text
