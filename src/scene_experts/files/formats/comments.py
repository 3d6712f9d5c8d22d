"""A note on how a file was made, kept as one comment line of a PLY header, which readers of PLY skip."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

MARK = "scene-experts"
_HEADER_LIMIT = 1 << 20
_NOTE_LIMIT = 1 << 16  # readers hold a header's lines in buffers of their own


def note_comments(note: Mapping[str, Any]) -> list[str]:
    """The comment lines of a note: none for an empty one, else "scene-experts {...}" in JSON and ASCII.

    What makes a note longer than 64 KiB (long lists of figures) is left out, the longest entries first.
    """
    kept = dict(note)
    text = json.dumps(kept, allow_nan=False, default=str)
    while len(text) > _NOTE_LIMIT:
        del kept[max(kept, key=lambda name: len(json.dumps(kept[name], default=str)))]
        text = json.dumps(kept, allow_nan=False, default=str)
    return [f"{MARK} {text}"] if kept else []


def read_note(path: Path) -> dict[str, Any]:
    """The note in a PLY file's header; {} where there is none or it cannot be read."""
    with Path(path).open("rb") as stream:
        head = stream.read(_HEADER_LIMIT).split(b"\nend_header", 1)[0]
    start = f"comment {MARK} ".encode()
    for line in head.splitlines():
        if line.startswith(start):
            try:
                found = json.loads(line[len(start) :])
            except ValueError:
                return {}
            return found if isinstance(found, dict) else {}
    return {}
