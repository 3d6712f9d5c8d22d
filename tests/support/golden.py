"""Recorded values in tests/golden: a test compares with them, or writes them while SCENE_EXPERTS_RECORD is set.

`make record-errors` and `make record-flags` record the sentences and the flags of the command line anew. Recording runs in one process.
"""

import json
import os
from collections.abc import Callable
from typing import Any

from support.places import GOLDEN

RECORDING = bool(os.environ.get("SCENE_EXPERTS_RECORD"))


def recorded_text(name: str, found: str) -> str:
    """The text of tests/golden/NAME. While recording, `found` is written there first."""
    path = GOLDEN / name
    if RECORDING:
        path.write_text(found)
    return path.read_text()


def recorded(name: str, key: str, record: Callable[[], Any]) -> Any:
    """The value under `key` in the JSON file tests/golden/NAME, or None. While recording, the result of `record` is written there first."""
    path = GOLDEN / name
    values = json.loads(path.read_text()) if path.exists() else {}
    if RECORDING:
        values[key] = record()
        path.write_text(json.dumps(dict(sorted(values.items())), indent=1) + "\n")
    return values.get(key)
