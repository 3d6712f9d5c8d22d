"""Options of a film: what `scene-experts render` draws along a camera path."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Annotated, Literal

from scene_experts.arguments.option import Option
from scene_experts.core.errors import InputError, expect_at_least
from scene_experts.view.show import Show


@dataclass(frozen=True)
class FilmOptions:
    """Camera path and picture."""

    path: str = "auto"
    """Camera path: orbit, spiral, views (through the captured poses), test (each held-out view), auto (the one of these that fits
    the cameras), or a JSON file of this package or of nerfstudio."""
    seconds: float = 8.0
    """Duration of orbit, spiral and views."""
    frames: int | None = None
    """Number of frames of orbit, spiral and views, instead of --seconds."""
    fps: float | None = None
    """Frames per second; by default 24, or what the path's file says."""
    size: Annotated[str | None, Option(value="WIDTHxHEIGHT")] = None
    """Size of the picture in pixels; by default that of the training views. The vertical field of view stays."""
    show: tuple[Show, ...] = ("picture",)
    """What to show; several are placed side by side."""
    attribute: Literal["opacity", "cov", "color"] = "color"
    """Attribute whose experts are shown."""
    only: tuple[int, ...] = ()
    """Draw only the anchors of these experts, counted from 1."""
    quality: int = 8
    """Quality of the video, 1 to 10."""

    def check(self) -> None:
        """Raises InputError, naming the option, for invalid values."""
        fps = 1.0 if self.fps is None else self.fps
        expect_at_least([("--seconds", self.seconds, 0.01), ("--fps", fps, 0.1), ("--quality", self.quality, 1)])
        expect_at_least([("--frames", 1 if self.frames is None else self.frames, 1)])
        expect_at_least([("--only", number, 1) for number in self.only])
        if self.quality > 10:
            raise InputError(f"expected --quality of at most 10, found {self.quality}; give a smaller number")
        self.pixels()

    def pixels(self) -> tuple[int, int] | None:
        """Width and height of `size`. Raises InputError if it is not WIDTHxHEIGHT."""
        if self.size is None:
            return None
        found = re.fullmatch(r"(\d{1,5})[xX](\d{1,5})", self.size)
        if not found or not all(16 <= int(v) <= 16384 for v in found.groups()):
            raise InputError(f"expected --size as WIDTHxHEIGHT of 16 to 16384 pixels, found '{self.size}'; write for example 640x360")
        return int(found[1]), int(found[2])
