"""What the process tells the one that started it."""

from __future__ import annotations

import json
from typing import Any


def report(**what: Any) -> None:
    """Write a line of JSON to standard output."""
    print(json.dumps(what), flush=True)
