"""What `info` prints is what the capture says."""

import io
from types import SimpleNamespace

import pytest
from rich.console import Console

from scene_experts.data.report import show, text


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (True, "yes"),
        (False, "no"),
        (1234567, "1,234,567"),
        (0.1 + 0.2, "0.3"),
        ({"48x32": 4, "40x36": 3}, "48x32 4, 40x36 3"),
        ([0.0, 1.5], "0, 1.5"),
        ("mod8", "mod8"),
        (None, "None"),
    ],
)
def test_facts_as_a_person_writes_them(value, said):
    assert text(value) == said


def test_one_fact_a_row_then_the_warnings_whole():
    out = io.StringIO()
    long = "a warning " * 30
    capture = SimpleNamespace(summary=lambda: {"test_views": 12, "warnings": [long]}, warnings=(long,))
    show(capture, Console(file=out, width=60))  # type: ignore[arg-type]
    rows = out.getvalue().splitlines()
    assert rows[0].split() == ["test", "views", "12"] and rows[1] == f"warning: {long}" and len(rows) == 2
