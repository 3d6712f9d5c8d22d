"""The commands, a function each: flags in, exit code out. The only place a device is chosen."""

from __future__ import annotations

from importlib import import_module

from scene_experts.core.signals import follow_parent

HANDLERS: dict[str, tuple[str, str]] = {
    "capture": ("capture", "capture"),
    "info": ("inspect", "info"),
    "train": ("train", "train"),
    "eval": ("evaluate", "evaluate"),
    "compare": ("evaluate", "compare"),
    "render": ("render", "render"),
    "view": ("view", "view"),
    "report": ("report", "report"),
    "export": ("files", "export"),
    "import": ("files", "import_"),
    "reproduce": ("reproduce", "reproduce"),
    "bench": ("bench", "bench"),
    "catalog": ("catalog", "catalog"),
    "download": ("catalog", "download"),
    "doctor": ("inspect", "doctor"),
}
"""Module of this package and function, by command: only the modules of the command that runs are imported."""


def run(command: str, args: list[str]) -> int:
    """Run a command of HANDLERS; returns its exit code."""
    follow_parent()
    module, function = HANDLERS[command]
    return getattr(import_module(f"{__name__}.{module}"), function)(args)
