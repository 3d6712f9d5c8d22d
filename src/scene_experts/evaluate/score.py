"""Evaluates a trained scene: renders views, scores their 8-bit pixels, which it also writes to
disk, and states everything that the scores depend on.

OUT/test/{renders,gt,errors,side_by_side}/<view name>.png    pictures of each view; masks/ if the
capture has masks OUT/test/experts/<attribute>.png                             the first view drawn
for each expert alone, if the scene has experts OUT/results.json, OUT/per_view.json
mean scores and scores of each view

The names change with the options: OUT/train and results_train.json for training views,
OUT/test_half and results_half.json for appearance codes that are fitted to half of each photograph.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from scene_experts.core.errors import InputError, expect_words
from scene_experts.core.group import Alone
from scene_experts.core.io import write_json
from scene_experts.core.progress import Progress
from scene_experts.core.types import Camera, Decoded, Mode, Render
from scene_experts.evaluate import halves, pictures, results
from scene_experts.evaluate.alignment import align
from scene_experts.evaluate.experts import write_expert_strips
from scene_experts.evaluate.metrics import Perceptual, score
from scene_experts.evaluate.options import EvalOptions
from scene_experts.evaluate.photographs import NAME as TRAINING_VIEWS
from scene_experts.evaluate.results import About
from scene_experts.evaluate.timing import measure_speed

if TYPE_CHECKING:
    from scene_experts.data.capture import Capture
    from scene_experts.render import Rasterizer
    from scene_experts.scene import Draws, Scene

FORMAT = 1
NO_VIEWS = {
    "test": "train with another --split (for example mod8), or score the training views with --views train",
    "train": "choose another --split",
}


def evaluate(
    scene: Scene,
    capture: Capture,
    rasterize: Rasterizer,
    out: Path,
    options: EvalOptions | None = None,
    *,
    step: int,
    about: About | None = None,
    progress: Progress | None = None,
    group: Alone | None = None,
) -> dict[str, Any]:
    """Render, score and time the views of a split. The scene is drawn on its own device.

    Args:
        out: Folder of the results, usually the run folder.
        options: Which views are scored, and how.
        step: Iteration whose schedule values (such as Top-k) the scene uses.
        about: Facts about the training for the results file.
        progress: Called with the name of the work, how much is done and how much there is.
        group: The processes that share the views; None: this process alone. Process 0 measures the
            speed and writes the results.

    Returns:
        The content of results.json; empty in other processes than process 0.

    Raises:
        InputError: if the split has no views or the options do not fit the scene.
        RunError: if the results cannot be written.
    """
    options, tell, group = options or EvalOptions(), progress or (lambda *_: None), group or Alone()
    chosen = choose_views(capture, options)
    began = time.perf_counter()
    device = scene.table.device
    background = torch.tensor(capture.background, dtype=torch.float32, device=device)
    perceptual = group.in_turn(lambda: load_perceptual(options, device, tell))
    files = pictures.make_file_names(capture.views[i].name for i in chosen)
    cameras = [capture.views[i].camera.to(device) for i in chosen]
    mine = range(group.rank, len(chosen), group.size)
    fitted: AbstractContextManager[None] = nullcontext()
    if options.appearance == "half":
        fitting: Callable[[int, int], None] = lambda done, total: tell("fitting appearance codes", done, total)  # noqa: E731
        fitted = halves.fitted_codes(scene, capture, rasterize, [chosen[n] for n in mine], step, background, fitting)
    with fitted, pictures.replacing(out / options.folder, group.first) as folder, pictures.Writer() as writer:
        group.wait()
        drawing = Drawing(scene.frozen(step), rasterize, step, background, options.appearance == "half", scene.as_photographed)
        aligns = options.views == "test" and (options.align_poses or scene.poses is not None)

        def score_view(n: int) -> dict[str, Any]:
            index, file = chosen[n], files[capture.views[chosen[n]].name]
            capture.images.prefetch([chosen[later] for later in mine if later > n][:2])
            if aligns:
                cameras[n] = drawing.align(capture, index, cameras[n], scene.extent)
            shown, facts = drawing.draw(capture, index, cameras[n])
            scores = shown.score(perceptual, device)
            writer.submit(partial(shown.write, folder, file, scores))
            tell("rendering and scoring", n + 1, len(chosen))
            return {"file": file, **scores, **facts}

        def score_views() -> dict[int, dict[str, Any]]:
            scored = {n: score_view(n) for n in mine}
            writer.finish()  # before process 0 gives the folder its name
            return scored

        parts = group.gather_values((group.agree(score_views), perceptual.absent))
        if not group.first:
            return {}
        per_view = collect(parts, [capture.views[index].name for index in chosen], perceptual)
        write_expert_strips(folder, scene, cameras[0], step, rasterize, background)
        found = {
            "format": FORMAT,
            **results.describe_scores(per_view, perceptual),
            **results.describe_scene(scene, step),
            **{name: results.mean_over_views(per_view, name) for name in ("gaussians_rendered", "activation_ratio")},
            "fps": asdict(measure_speed(scene, cameras, step, rasterize, background)),
            **results.describe_views(capture, cameras, options, aligns),
            **results.describe_run(about or About(), step, rasterize, perceptual),
            "evaluation_seconds": time.perf_counter() - began,
        }
        if not options.suffix:
            (out / f"{TRAINING_VIEWS}.json").unlink(missing_ok=True)  # it may be of another iteration
        write_json(out / f"per_view{options.suffix}.json", per_view)
        write_json(out / f"results{options.suffix}.json", found)
        return found


def collect(
    parts: Iterable[tuple[dict[int, dict[str, Any]], dict[str, str]]], names: Sequence[str], perceptual: Perceptual
) -> dict[str, Any]:
    """Return the scores by view of all processes. names: of the scored views, in order."""
    by_place: dict[int, dict[str, Any]] = {}
    for values, absent in parts:
        by_place |= values
        perceptual.absent.update(absent)  # a score that one process lacks is not the mean of the others' views
    return {name: by_place[n] for n, name in enumerate(names)}


def choose_views(capture: Capture, options: EvalOptions) -> tuple[int, ...]:
    """Return the views to score.

    Raises InputError for an unknown word in the options, if there are no views, or if codes would
    be fitted to training views.
    """
    expect_words(options)
    views = options.views
    chosen = capture.test if views == "test" else capture.train
    if not chosen:
        raise InputError(f"expected at least one {views} view in {capture.name}, found none (split {capture.split}); {NO_VIEWS[views]}")
    if options.appearance == "half" and views == "train":
        raise InputError("training views already have appearance codes: use --appearance half without --views train")
    if options.align_poses and views == "train":
        raise InputError("expected held-out views for --align-poses, found training views, which keep their poses; leave --align-poses out")
    return chosen


def load_perceptual(options: EvalOptions, device: torch.device, tell: Progress) -> Perceptual:
    """Return the LPIPS networks that are available."""
    if not options.lpips:
        return Perceptual.off()
    downloading: Callable[[int, int], None] = lambda have, total: tell("downloading LPIPS weights, MiB", have >> 20, total >> 20)  # noqa: E731
    return Perceptual.find(options.lpips_weights, device, fetch=options.download_lpips, progress=downloading)


@dataclass(frozen=True)
class Shown:
    """A view as 8-bit pixels: what is scored and written."""

    render: np.ndarray  # [H, W, 3]
    photo: np.ndarray  # [H, W, 3]
    mask: np.ndarray | None  # [H, W]

    def score(self, perceptual: Perceptual, device: torch.device | str = "cpu") -> dict[str, Any]:
        """Return the scores. They are empty if the mask excludes every pixel."""
        if self.mask is not None and not self.mask.any():
            return {}
        render, photo = (pictures.from_8bit(pixels).to(device) for pixels in (self.render, self.photo))
        mask = None if self.mask is None else pictures.from_8bit(self.mask).to(device)
        return {**score(render, photo, mask, perceptual), "masked": mask is not None}

    def write(self, folder: Path, file: str, scores: dict[str, Any]) -> None:
        """Write render, photograph, mask and error map, and all but the mask beside each other with
        their scores, into a folder that only counts once it is whole."""
        parts = ["render"]
        if scores:
            parts += [f"{scores['psnr']:.2f} dB", f"SSIM {scores['ssim']:.3f}"]
            parts += [f"LPIPS {scores['lpips']:.3f}"] if "lpips" in scores else []
        captions = ("photograph", "  ".join(parts), f"error, 0 to {pictures.WORST:g}")
        errors = pictures.draw_error_map(self.render, self.photo, self.mask)
        sheet = pictures.compose_comparison(self.photo, self.render, errors, captions)
        kinds = {"renders": self.render, "gt": self.photo, "masks": self.mask, "errors": errors, "side_by_side": sheet}
        for kind, pixels in kinds.items():
            if pixels is not None:
                pictures.write_picture(folder / kind / file, pixels, sync=False)


@dataclass(frozen=True)
class Drawing:
    """Draws views of a scene beside their photographs."""

    draws: Draws
    rasterize: Rasterizer
    step: int
    background: Tensor  # [3]
    half: bool  # score only the right half of each view
    as_photographed: Callable[[Tensor, Camera], Tensor]

    def align(self, capture: Capture, index: int, camera: Camera, extent: float) -> Camera:
        """Return the camera of view `index` aligned with the scene by the photograph, by its left
        half with `half`."""
        frame, device = capture.frame(index), self.background.device
        counts = frame.mask
        if self.half:
            left = halves.left_half(camera.height, camera.width)
            counts = left if counts is None else left * counts.cpu()
        photo = (frame.rgb.float() / 255).to(device)
        return align(self.draws, self.rasterize, camera, photo, counts, self.step, self.background, extent, self.as_photographed)

    @torch.no_grad()
    def draw(self, capture: Capture, index: int, camera: Camera) -> tuple[Shown, dict[str, Any]]:
        """Draw view `index`. Returns its pixels and the counts of the view."""
        frame = capture.frame(index)
        decoded = self.draws(camera, self.step, Mode.DRAW, self.rasterize.visible)
        render = self.rasterize(decoded.gaussians, camera, self.background)
        image = self.as_photographed(render.image, camera)
        photo, drawn = frame.rgb.cpu().numpy(), pictures.to_8bit(image)
        if photo.shape != drawn.shape:
            raise InputError(
                f"expected {capture.views[index].name} with {drawn.shape[1]} x {drawn.shape[0]} px, found "
                f"{photo.shape[1]} x {photo.shape[0]} px; load the capture again"
            )
        mask = halves.right_half(frame.mask, *photo.shape[:2]) if self.half else frame.mask
        levels = None if mask is None else (mask.clamp(0, 1) * 255 + 0.5).to(torch.uint8).cpu().numpy()
        return Shown(drawn, photo, levels), count_gaussians(decoded, render)


def count_gaussians(decoded: Decoded, render: Render) -> dict[str, Any]:
    """Return the counts of one view. The activation ratio is the fraction of Gaussians with
    positive opacity (MoE-GS, Table 3)."""
    raw = decoded.raw_opacity
    return {
        "anchors_visible": len(decoded.rows),
        "gaussians_decoded": len(decoded.gaussians),
        "gaussians_rendered": int((render.radii > 0).sum()),
        "activation_ratio": None if raw is None else float((raw > 0).double().mean()) if raw.numel() else 0.0,
    }
