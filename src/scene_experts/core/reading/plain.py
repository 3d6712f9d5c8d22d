"""Reads JSON, lines of JSON and Python literals: plain values, nested within the budget, with
finite numbers only."""

from __future__ import annotations

import ast
import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from scene_experts.core.reading import budget as budgets
from scene_experts.core.reading.budget import Budget, Damaged
from scene_experts.core.reading.source import opening

JSON_STARTS = (b"{", b"\xef\xbb\xbf{", b" ", b"\t", b"\r", b"\n")
"""First bytes of a JSON file that may hold an object."""
_BITS = 64  # of an integer
_LONGEST_VALUE = 4096  # characters of a Python literal


def decode_text(data: bytes) -> str:
    """Return the text of a file: UTF-8, with or without a byte order mark, or UTF-16 with one.
    Bytes that are no UTF-8 become surrogates."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16", "replace")
    return data.decode("utf-8-sig", "surrogateescape")


def read_json(path: Path, what: str) -> Any:
    """Read the JSON file `path`: UTF-8 in every locale, with or without a byte order mark.

    `what` names the file in messages, for example "run configuration". Raises InputError if the
    file is absent or is not valid JSON, and for values beyond the budget: see `parse_json`.
    """
    with opening(path, budgets.JSON, f"{what} in JSON") as source:
        return parse_json(source.read(), budgets.JSON)


def parse_json(text: bytes | str, budget: Budget = budgets.META, finite: bool = True) -> Any:
    """Parse JSON text. Raises ValueError if it is invalid, too long or nested too deeply, has too
    many values, or has numbers that are not finite or integers of more than 64 bits. `finite=False`
    allows NaN and infinity, which metrics of a training may have.
    """
    if len(text) > budget.bytes_in:
        raise Damaged(f"{len(text):,} bytes of JSON, more than the {budget.bytes_in:,} that are read")
    value = json.loads(text)
    check_plain(value, budget, finite)
    return value


def check_plain(value: Any, budget: Budget, finite: bool = True) -> None:
    """Raise Damaged for nested plain values beyond the budget's items and depth, and for numbers
    out of range."""
    level, depth, items = [value], 0, 0
    while level:  # breadth first: no recursion, whatever the nesting
        items += len(level)
        if items > budget.items:
            raise Damaged(f"more than {budget.items:,} values")
        below: list[Any] = []
        for found in level:
            kind = type(found)
            if kind is dict:
                below.extend(found.values())
            elif kind is list or kind is tuple:
                below.extend(found)
            elif kind is float:
                if finite and not math.isfinite(found):
                    raise Damaged("a number that is not finite")
            elif kind is int and found.bit_length() > _BITS:
                raise Damaged(f"an integer of more than {_BITS} bits")
        level, depth = below, depth + 1
        if depth > budget.depth + 1:
            raise Damaged(f"values nested more than {budget.depth} deep")


def read_json_lines(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the objects of a file of one JSON object per line. Other lines are skipped: a power
    failure may leave anything."""
    with opening(path, budgets.LINES) as source, source.stream() as stream:
        for line in iter(lambda: stream.readline(budgets.LINE.bytes_in), b""):
            source.spend_items(1)
            try:
                found = parse_json(line.decode(errors="replace"), budgets.LINE, finite=False)
            except (ValueError, RecursionError):
                continue
            if isinstance(found, dict):
                yield found


def parse_namespace(text: str, budget: Budget = budgets.SETTINGS) -> dict[str, Any]:
    """Parse the text of a Python namespace, `Namespace(name=value, ...)`, as programs of the 3DGS
    family write it.

    Values are parsed as literals and never evaluated. Other values (a path object, a call) are left
    out. Raises Damaged for a text of another form.
    """
    match = re.fullmatch(r"Namespace\((.*)\)", text.strip(), re.S)
    if match is None:
        raise Damaged("a text of another form")
    out: dict[str, Any] = {}
    for count, part in enumerate(_split_arguments(match[1])):
        if count >= budget.items:
            raise Damaged(f"more than {budget.items:,} settings")
        name, equals, value = part.partition("=")
        if not equals or not name.strip().isidentifier() or not value.strip():
            raise Damaged("a text of another form")
        literal, fits = parse_literal(value.strip(), budget)
        if fits:
            out[name.strip()] = literal
    return out


def parse_literal(text: str, budget: Budget = budgets.SETTINGS) -> tuple[Any, bool]:
    """Return the value of a short Python literal and True, or None and False for any other text."""
    opened = max((text.count(c) for c in "([{"), default=0)
    if len(text) > _LONGEST_VALUE or opened > 200 or re.search(r"[-+~][-+~\s]*[-+~][-+~\s]*[-+~]|\bnot\b|\blambda\b", text):
        return None, False  # the parser of Python is not made for hostile nesting
    try:
        value = ast.literal_eval(text)
        check_plain(list(value) if isinstance(value, (set, frozenset)) else value, budget)
    except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError):
        return None, False
    return value, True


def _split_arguments(text: str) -> Iterator[str]:
    """Yield the parts of a text between commas that are outside brackets and quotes."""
    start, depth, quote, at = 0, 0, "", 0
    while at < len(text):
        c = text[at]
        if quote:
            at += c == "\\"
            quote = "" if c == quote else quote
        elif c in "'\"":
            quote = c
        elif c in "([{":
            depth += 1
        elif c in ")]}":
            depth -= 1
            if depth < 0:
                raise Damaged("a text of another form")
        elif c == "," and depth == 0:
            yield text[start:at]
            start = at + 1
        at += 1
    if quote or depth:
        raise Damaged("a text of another form")
    if text[start:].strip():
        yield text[start:]
