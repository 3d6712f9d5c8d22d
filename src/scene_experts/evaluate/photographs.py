"""Every photograph of a run by how badly the scene fits it, so that a bad one (blurred, another
exposure, a finger) is found.

`eval` scores the training views too, at a reduced size:

OUT/training_views.json                             size and PSNR of each training view
OUT/training_views/{renders,gt}/<view name>.png     the worst of them
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.group import Alone
from scene_experts.core.io import read_json, write_json
from scene_experts.core.progress import Progress
from scene_experts.core.reading.budget import RUN
from scene_experts.core.reading.source import guarding, inside, sentence
from scene_experts.core.types import Mode
from scene_experts.data import prepare
from scene_experts.evaluate import pictures
from scene_experts.evaluate.metrics import psnr
from scene_experts.evaluate.results import command_of

if TYPE_CHECKING:
    from scene_experts.data.capture import Capture
    from scene_experts.render import Rasterizer
    from scene_experts.scene import Scene

NAME = "training_views"
LONGEST = 480  # px; training views are scored at most this large
WORST = 12  # photographs whose pictures are kept and shown
CACHE = 64 << 20  # bytes for decoded frames
FAR, LEAST = 3.0, 3.0  # an outlier is more standard deviations and more dB than these below the median
ENOUGH = 5  # views of a part that have a median worth comparing with
MANY = 5  # more outliers than one in so many photographs are no slips
NAMED = 5  # outliers that the terminal names


@dataclass(frozen=True)
class Photograph:
    """A photograph and how well the scene fits it. `median`: of the PSNR of its part of the split,
    because held-out views always have less than training views."""

    name: str
    part: str  # "training" or "held out"
    file: str  # of its pictures
    psnr: float
    median: float
    outlier: bool

    folder: str  # of its pictures in the run folder


Shown = dict[str, tuple[np.ndarray, np.ndarray]]
"""Photograph and render, uint8 [H, W, 3], by the name of a view."""


def score_training_views(
    scene: Scene, capture: Capture, rasterize: Rasterizer, out: Path, step: int, tell: Progress | None = None, group: Alone | None = None
) -> None:
    """Draw the training views at most LONGEST px large, and write their scores and the pictures of
    the worst ones to the folder `out`. The arguments are those of `score.evaluate`."""
    group, tell = group or Alone(), tell or (lambda *_: None)
    device, draws = scene.table.device, scene.frozen(step)
    background = torch.tensor(capture.background, dtype=torch.float32, device=device)
    files = pictures.make_file_names(capture.views[i].name for i in capture.train)
    mine = capture.train[group.rank :: group.size]
    small = prepare.limit_size(capture, LONGEST, CACHE)

    def score_mine() -> tuple[dict[str, dict[str, Any]], Shown]:
        found: dict[str, dict[str, Any]] = {}
        shown: Shown = {}
        for n, index in enumerate(mine):
            small.images.prefetch(mine[n + 1 : n + 3])
            view, frame = small.views[index], small.frame(index)
            camera = view.camera.to(device)
            with torch.no_grad():
                image = rasterize(draws(camera, step, Mode.DRAW, rasterize.visible).gaussians, camera, background).image
                image = scene.as_photographed(image, camera)
            drawn, photo = pictures.to_8bit(image), frame.rgb.cpu().numpy()
            if frame.mask is None or bool(frame.mask.any()):
                value = psnr(pictures.from_8bit(drawn), pictures.from_8bit(photo), None if frame.mask is None else frame.mask.cpu())
                found[view.name] = {"file": files[view.name], "psnr": value, "width": camera.width, "height": camera.height}
                shown[view.name] = (photo, drawn)
                if len(shown) > WORST:
                    del shown[max(shown, key=lambda name: found[name]["psnr"])]
            tell("looking at the training views", n + 1, len(mine))
        return found, shown

    try:
        parts = group.gather_values(group.agree(score_mine))
    finally:
        small.images.close()
    if not group.first:
        return
    scores = {name: facts for found, _ in parts for name, facts in found.items()}
    shown = {name: pair for _, kept in parts for name, pair in kept.items()}
    with pictures.replacing(out / NAME) as folder:
        for name in sorted(shown, key=lambda name: scores[name]["psnr"])[:WORST]:
            for kind, pixels in zip(("gt", "renders"), shown[name]):
                pictures.write_picture(folder / kind / files[name], pixels)
    order = (capture.views[i].name for i in capture.train)
    write_json(out / f"{NAME}.json", {name: scores[name] for name in order if name in scores})


def read_photographs(run: Path) -> list[Photograph]:
    """Return the photographs of an evaluated run, those that lie furthest below the median of their
    part first; without training views if these were not scored.

    Raises InputError for files that are not those of an evaluation.
    """
    parts = [("held out", "per_view.json", "test"), ("training", f"{NAME}.json", NAME)]
    if not any((run / file).is_file() for _, file, _ in parts):  # a run that holds none out
        parts = [("training", "per_view_train.json", "train")]
    found = [each for part, file, folder in parts for each in _rank(part, folder, _read(run / file))]
    return sorted(found, key=lambda each: each.psnr - each.median)


def describe_outliers(found: list[Photograph]) -> list[str]:
    """Return a line for each photograph that fits far worse than the others, at most NAMED; one
    line for all of them if there are many."""
    bad = [each for each in found if each.outlier]
    if len(bad) > 2 and len(bad) * MANY > len(found):  # then no single one is to blame
        names = ", ".join(each.name for each in bad[:NAMED]) + (", ..." if len(bad) > NAMED else "")
        said = f"{len(bad)} of {len(found)} photographs fit the others badly ({names}): what they show is hard to match, or few show it"
        return [sentence(f"{said}; more photographs of it help, leaving them out does not; report.html lists them")]
    lines = [
        f"{each.name} fits the others badly ({each.psnr:.1f} dB, median {each.median:.1f}): look at it in report.html; "
        f"leave it out with --leave-out {shlex.quote(each.name)}"
        for each in bad[:NAMED]
    ]
    more = [f"{len(bad) - NAMED} more fit badly: report.html lists them"] if len(bad) > NAMED else []
    return [sentence(line) for line in lines + more]


def _read(path: Path) -> dict[str, dict[str, Any]]:
    value = read_json(path, "scores by view") if path.is_file() else {}
    if not isinstance(value, dict) or not all(isinstance(v, dict) and isinstance(v.get("file"), str) for v in value.values()):
        raise InputError(f"expected scores by view in {path}, found something else; run `{command_of(path.parent)}` again")
    with guarding(path, RUN, "file of scores by view"):
        for facts in value.values():
            inside(path.parent, facts["file"])
    return value


def _rank(part: str, folder: str, views: dict[str, dict[str, Any]]) -> list[Photograph]:
    scored = {name: facts for name, facts in views.items() if isinstance(facts.get("psnr"), (int, float))}
    if not scored:
        return []
    middle = median(facts["psnr"] for facts in scored.values())
    spread = 1.4826 * median(abs(facts["psnr"] - middle) for facts in scored.values())  # as the deviation of a normal distribution
    limit = middle - max(LEAST, FAR * spread) if len(scored) >= ENOUGH else float("-inf")
    return [Photograph(name, part, facts["file"], facts["psnr"], middle, facts["psnr"] < limit, folder) for name, facts in scored.items()]
