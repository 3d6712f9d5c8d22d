"""What a file costs: the same views drawn from several scenes, scored against the photographs and
against the first scene's pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.types import Camera, Gaussians, Mode
from scene_experts.data.capture import Capture
from scene_experts.evaluate.metrics import psnr
from scene_experts.render import Rasterizer, as_trained, choose
from scene_experts.scene import Draws, Scene
from scene_experts.training.run_folder import OpenRun, capture_of

LOSS = 1.0  # dB; a file that loses more gets a warning
OF_THE_BAKE = "refine it (without --refine 0), or let it have more Gaussians (--max-gaussians, --prune) or a higher --sh-degree"
OF_THE_FORMAT = "the format holds the scene too coarsely: choose another --format"
Tell = Callable[[str, int, int], None]
"""Reports the progress of long work: (what, done, total)."""


@dataclass(frozen=True)
class Painter:
    """Draws one scene at one step."""

    draws: Draws
    step: int
    rasterize: Rasterizer

    @classmethod
    def of(cls, scene: Scene, step: int, rasterize: Rasterizer | None = None, antialias: bool = False) -> Painter:
        """A painter for a trained scene, which must not change meanwhile. rasterize: None for the
        fastest one on this CPU."""
        return cls(scene.frozen(step), step, as_trained(rasterize or choose("auto", "cpu"), antialias))

    def gaussians(self, camera: Camera) -> Gaussians:
        """The Gaussians that a camera sees."""
        return self.draws(camera, self.step, Mode.DRAW, self.rasterize.visible).gaussians

    def picture(self, camera: Camera, background: Tensor) -> Tensor:
        """The picture [H, W, 3] over `background` [3], not clamped."""
        return self.rasterize(self.gaussians(camera), camera, background).image

    def picture_8bit(self, camera: Camera, background: Tensor) -> Tensor:
        """The picture [H, W, 3] as an 8-bit file holds it, in [0, 1]."""
        return round_to_8_bit(self.picture(camera, background))


def round_to_8_bit(picture: Tensor) -> Tensor:
    """A picture [H, W, 3] as an 8-bit file holds it, in [0, 1]."""
    return (picture.clamp(0, 1) * 255 + 0.5).floor() / 255


@dataclass(frozen=True)
class Score:
    """Means over views, dB, from 8-bit pictures."""

    photographs: float
    """PSNR against the photographs."""
    first: float
    """PSNR against the pictures of the first scene; 100 for that scene itself."""


@dataclass(frozen=True)
class Cost:
    """What a file costs in PSNR. Empty where nothing was measured."""

    lines: tuple[str, ...]
    """A sentence: the figures, or why there are none."""
    psnr: dict[str, float] = field(default_factory=dict)
    """Mean PSNR of the held-out views against the photographs, dB, of the "run", of the "file", and
    for a baked scene of its "closed_form" and its "bake"."""
    plain: dict[str, Any] = field(default_factory=dict)
    """Everything as JSON values."""


def cost(
    run: OpenRun,
    scenes: Callable[[], Mapping[str, tuple[Scene, int]]],
    capture: Capture | None,
    rasterize: Rasterizer | None = None,
    tell: Tell | None = None,
) -> Cost:
    """Draw the held-out views of a capture from a run and from other scenes.

    scenes: makes them, with the step to draw each at; "file" is what a file holds, "closed_form"
    and "bake" lie before it. capture: None where it is gone.  rasterize: None for the fastest one
    on this CPU.
    """
    if run.cameras is not None:
        return Cost(lines=("no capture was given (--data): what the file costs in PSNR was not measured",))
    views = [] if capture is None else scored_views(capture)
    if capture is None or not views:
        where = f"the capture is not at {run.config.data.path} (say where it is with --data)"
        why = where if capture is None else why_no_views(capture)
        return Cost(lines=(f"{why}: what the file costs on views that were not trained on was not measured",))
    drawn = {"run": (run.scene, run.step), **scenes()}
    painters = {name: Painter.of(scene, step, rasterize, run.config.train.antialias) for name, (scene, step) in drawn.items()}
    found = scores(painters, capture, views, tell, run.scene.as_photographed)
    before, after = found["run"].photographs, found["file"].photographs
    lines = [f"PSNR of {len(views)} held-out views: run {before:.3f} dB, this file {after:.3f} dB ({after - before:+.3f})"]
    if "bake" in found:
        bake = f"{found['bake'].photographs:.3f} dB"
        way = f"baked {found['closed_form'].photographs:.3f} dB, refined {bake}" if "closed_form" in found else f"the bake {bake}"
        lines.append(f"on the way: {way}; PSNR against the run's pictures {found['file'].first:.2f} dB")
    plain: dict[str, Any] = {name: {"photographs": round(s.photographs, 6), "run": round(s.first, 6)} for name, s in found.items()}
    psnr = {name: score.photographs for name, score in found.items()}
    if before - after > LOSS:
        middle = found["bake"].photographs if "bake" in found else before
        mend = OF_THE_BAKE if before - middle > middle - after else OF_THE_FORMAT
        lines.append(f"warning: the file loses {before - after:.1f} dB against the run; {mend}")
    return Cost(tuple(lines), psnr, plain | {"views": len(views)})


@contextmanager
def capture_if_there(run: OpenRun, needed: bool) -> Iterator[Capture | None]:
    """The capture of a run, or the cameras in its place; None where it is gone and not needed.
    Raises InputError where it is needed and gone, and for another one."""
    if run.cameras is not None:
        yield run.cameras
        return
    path = run.config.data.path
    if not path.exists():
        if needed:
            raise InputError(
                f"expected the run's capture at {path}, whose cameras this file is made with, found none; say where it is with --data"
            )
        yield None
        return
    capture = capture_of(run)
    try:
        yield capture
    finally:
        capture.images.close()


def scored_views(capture: Capture) -> list[int]:
    """The held-out views that can be scored: those whose mask leaves something."""
    return [i for i in capture.test if (mask := capture.frame(i).mask) is None or bool(mask.any())]


def why_no_views(capture: Capture) -> str:
    """Why `scored_views` is empty."""
    return "the masks leave nothing of the held-out views" if capture.test else "no view is held out"


@torch.no_grad()
def scores(
    painters: Mapping[str, Painter],
    capture: Capture,
    views: Sequence[int],
    tell: Tell | None = None,
    as_photographed: Callable[[Tensor, Camera], Tensor] = lambda picture, camera: picture,
) -> dict[str, Score]:
    """The score of each scene over `views` (at least one, of `scored_views`) of the capture.
    as_photographed: as `Scene.as_photographed`."""
    background = torch.tensor(capture.background)
    totals = {name: [0.0, 0.0] for name in painters}
    for i, index in enumerate(views):
        camera, frame = capture.views[index].camera, capture.frame(index)
        drawn = {name: painter.picture(camera, background) for name, painter in painters.items()}
        pictures = {name: round_to_8_bit(as_photographed(picture, camera)) for name, picture in drawn.items()}
        first = next(iter(pictures.values()))
        for name, image in pictures.items():
            totals[name][0] += psnr(image, frame.rgb.float() / 255, frame.mask)
            totals[name][1] += psnr(image, first, frame.mask)
        if tell is not None:
            tell("measuring", i + 1, len(views))
    return {name: Score(a / len(views), b / len(views)) for name, (a, b) in totals.items()}
