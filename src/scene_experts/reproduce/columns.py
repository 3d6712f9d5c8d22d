"""Lists of like objects as columns, and JSON text that is small and still readable in a diff: how a record is written."""

from __future__ import annotations

import json
from typing import Any

COMPACT = (",", ":")


def columns(rows: list[Any]) -> Any:
    """`[{"a": 1}, {"a": 2}]` as `{"a": [1, 2]}`, at every depth; unchanged where the rows are not all objects with the same keys."""
    if rows and all(isinstance(row, dict) for row in rows) and all(row.keys() == rows[0].keys() for row in rows):
        return {key: columns([row[key] for row in rows]) for key in rows[0]}
    return rows


def rows(found: Any, count: int) -> list[Any]:
    """The `count` rows that `columns` was given."""
    if isinstance(found, list):
        return found
    parts = {key: rows(column, count) for key, column in found.items()}
    return [{key: part[i] for key, part in parts.items()} for i in range(count)]


def length(found: Any) -> int:
    """The number of rows in columns; 0 where no column says it."""
    return len(found) if isinstance(found, list) else max(map(length, found.values()), default=0)


def text(value: Any, depth: int = 2) -> str:
    """JSON without indentation: one line for each entry of the objects of the first `depth` levels. Raises ValueError for NaN."""
    if depth == 0 or not isinstance(value, dict) or not value:
        return json.dumps(value, separators=COMPACT, allow_nan=False)
    lines = (f"{json.dumps(key)}:{text(each, depth - 1)}" for key, each in value.items())
    return "{\n" + ",\n".join(lines) + "\n}"
