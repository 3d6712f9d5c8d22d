"""The commands: options in, exit code out. The only place that chooses a device."""

from __future__ import annotations

from importlib import import_module

from scene_experts.core.signals import follow_parent

PROG = "scene-experts"

COMMANDS: dict[str, tuple[str, str]] = {
    "make": ("make:make", "Make a web page with a 3D scene from photographs or a video"),
    "capture": ("capture:capture", "Find camera poses and 3D points for photographs or a video"),
    "info": ("inspect:info", "Show what a capture contains"),
    "train": ("train:train", "Train a scene on a capture"),
    "eval": ("evaluate:evaluate", "Render and score the held-out views of a run"),
    "compare": ("evaluate:compare", "Compare the scores of several runs in one table"),
    "render": ("render:render", "Render a camera path to a video or to pictures"),
    "view": ("view:view", "Show a run in a browser"),
    "report": ("report:report", "Write one web page about one or more runs"),
    "export": ("files:export", "Write a trained scene to a file that other tools can open"),
    "import": ("files:import_", "Make a run folder from a published result or an exported file"),
    "blocks": ("blocks:blocks", "Plan blocks of a large capture, and merge their runs"),
    "reproduce": ("reproduce:reproduce", "Reproduce the paper's tables and figures"),
    "bench": ("bench:bench", "Measure how fast this machine is"),
    "catalog": ("catalog:catalog", "List the paper's 17 scenes, their licences and where they are"),
    "download": ("catalog:download", "Download scenes of the paper"),
    "doctor": ("inspect:doctor", "Check what works on this machine and what is missing"),
}
"""By command: module of this package and function, and the line of the help. Only the module of the
command that runs is imported."""


def run(command: str, args: list[str]) -> int:
    """Run a command of COMMANDS; returns its exit code."""
    follow_parent()
    module, _, function = COMMANDS[command][0].partition(":")
    return getattr(import_module(f"{__name__}.{module}"), function)(args)
