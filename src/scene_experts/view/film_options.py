"""Options of a film: what `scene-experts render` draws along a camera path."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from scene_experts.arguments.option import Option
from scene_experts.core.errors import InputError
from scene_experts.core.fields import Flag, Range
from scene_experts.view.show import Show


@dataclass(frozen=True)
class FilmOptions:
    """Camera path and picture."""

    path: str = "auto"
    """Camera path: orbit, spiral, views (through the captured poses), test (each held-out view),
    auto (the one of these that fits the cameras), or a JSON file of this package or of
    nerfstudio."""
    transform: Annotated[Path | None, Option(value="FILE")] = None
    """How nerfstudio's path came into its frame: its dataparser_transforms.json."""
    seconds: Annotated[float, Range(0.01)] = 8.0
    """Duration of orbit, spiral and views."""
    frames: Annotated[int | None, Range(1)] = None
    """Number of frames of orbit, spiral and views, instead of --seconds."""
    fps: Annotated[float | None, Range(0.1)] = None
    """Frames per second; by default 24, or what the path's file says."""
    size: Annotated[str | None, Option(value="WIDTHxHEIGHT")] = None
    """Size of the picture in pixels; by default that of the training views. The vertical field of
    view stays."""
    show: tuple[Show, ...] = ("picture",)
    """What to show; several are placed side by side."""
    attribute: Literal["opacity", "cov", "color"] = "color"
    """Attribute whose experts are shown."""
    only: Annotated[tuple[int, ...], Range(1)] = ()
    """Draw only the anchors of these experts, counted from 1."""
    quality: Annotated[int, Range(1, 10)] = 8
    """Quality of the video."""

    def check(self, flag: Flag) -> None:
        self.pixels()

    def pixels(self) -> tuple[int, int] | None:
        """Width and height of `size`. Raises InputError if it is not WIDTHxHEIGHT."""
        if self.size is None:
            return None
        found = re.fullmatch(r"(\d{1,5})[xX](\d{1,5})", self.size)
        if not found or not all(16 <= int(v) <= 16384 for v in found.groups()):
            raise InputError(f"expected --size as WIDTHxHEIGHT of 16 to 16384 pixels, found '{self.size}'; write for example 640x360")
        return int(found[1]), int(found[2])
