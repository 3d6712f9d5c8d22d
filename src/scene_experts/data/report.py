"""What `scene-experts info` prints."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from scene_experts.data.capture import Capture


def show(capture: Capture, console: Console) -> None:
    """Print what was detected, one fact a row, then the warnings."""
    table = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for key, value in capture.summary().items():
        if key != "warnings":
            table.add_row(str(key).replace("_", " "), text(value))
    console.print(table)
    for warning in capture.warnings:
        console.print(f"warning: {warning}", style="yellow", soft_wrap=True)


def text(value: object) -> str:
    """A fact as a person writes it."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, dict):
        return ", ".join(f"{k} {text(v)}" for k, v in value.items())
    if isinstance(value, (list, tuple)):
        return ", ".join(text(v) for v in value)
    return str(value)
