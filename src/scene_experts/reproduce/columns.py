"""Lists of objects as columns, and compact JSON text that stays readable in a diff. Records are
written this way."""

from __future__ import annotations

import json
from typing import Any

COMPACT = (",", ":")


def columns(rows: list[Any]) -> Any:
    """Return `[{"a": 1}, {"a": 2}]` as `{"a": [1, 2]}`, at every depth. Rows without the same keys
    stay as they are."""
    if rows and all(isinstance(row, dict) for row in rows) and all(row.keys() == rows[0].keys() for row in rows):
        return {key: columns([row[key] for row in rows]) for key in rows[0]}
    return rows


def rows(found: Any, count: int) -> list[Any]:
    """Return the `count` rows that `columns` was given."""
    if isinstance(found, list):
        return found
    parts = {key: rows(column, count) for key, column in found.items()}
    return [{key: part[i] for key, part in parts.items()} for i in range(count)]


def length(found: Any) -> int:
    """Return the number of rows of `columns`; 0 without a column."""
    return len(found) if isinstance(found, list) else max(map(length, found.values()), default=0)


def text(value: Any, depth: int = 2) -> str:
    """Return JSON without indentation, one line for each entry of the objects in the first `depth`
    levels. Raises ValueError for NaN."""
    if depth == 0 or not isinstance(value, dict) or not value:
        return json.dumps(value, separators=COMPACT, allow_nan=False)
    lines = (f"{json.dumps(key)}:{text(each, depth - 1)}" for key, each in value.items())
    return "{\n" + ",\n".join(lines) + "\n}"
