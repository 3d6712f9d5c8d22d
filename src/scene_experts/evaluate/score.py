"""Evaluates a trained scene: renders held-out views to disk, scores the 8-bit files, and states everything the scores depend on.

OUT/test/{renders,gt,errors,side_by_side}/<view name>.png (masks/ too where the capture has any), OUT/results.json, OUT/per_view.json; of a
scene with experts OUT/test/experts/<attribute>.png too, the first view by the anchors of each expert alone. With views="train" the same in
OUT/train, OUT/results_train.json and OUT/per_view_train.json; with appearance="half" in OUT/test_half and so on.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.io import write_json
from scene_experts.core.types import Camera, Decoded, Mode, Render
from scene_experts.evaluate import expert_pictures, halves, pictures, timing
from scene_experts.evaluate.experts import expert_shares
from scene_experts.evaluate.metrics import VARIANTS, Perceptual, score
from scene_experts.evaluate.options import EvalOptions
from scene_experts.training import run_folder

if TYPE_CHECKING:
    from scene_experts.data.capture import Capture
    from scene_experts.render import Rasterizer
    from scene_experts.scene import Draws, Scene

FORMAT = 1
Progress = Callable[[str, int, int], None]  # what is being done, how far, of how many


@dataclass(frozen=True)
class About:
    """What the run was, for the results file."""

    recipe: str = ""
    iterations: int = 0
    seed: int = 0
    train_seconds: float = 0.0  # wall time of the training loop, without saving and previews
    versions: dict[str, str] = field(default_factory=dict)  # of the training; the evaluation's own are added
    cpu_seconds: float | None = None  # CPU time of the training loop; None: unknown
    load: dict[str, float | None] = field(default_factory=dict)  # of the machine during the training: `Clock.load`


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
) -> dict[str, Any]:
    """Render, score and time the views of a split. The scene is drawn on the device of its parameters.

    step: iteration whose schedule values (such as Top-k) the scene uses.
    Returns what results.json holds. Raises InputError if the split has no views, RunError if the disk is full.
    """
    options = options or EvalOptions()
    chosen = _chosen(capture, options)
    began = time.perf_counter()
    tell = progress or (lambda *_: None)
    device = next(iter(scene.table.params.values())).device
    background = torch.tensor(capture.background, dtype=torch.float32, device=device)
    perceptual = _perceptual(options, device, tell)
    names = pictures.file_names(capture.views[i].name for i in chosen)
    cameras = [capture.views[i].camera.to(device) for i in chosen]
    half = options.appearance == "half"
    if half:
        halves.fit(scene, capture, rasterize, chosen, step, background, lambda done, total: tell("finding appearance codes", done, total))
    folder = out / options.folder
    pictures.clear(folder)
    per_view: dict[str, dict[str, Any]] = {}
    draws = scene.frozen(step)
    for n, (index, camera) in enumerate(zip(chosen, cameras)):
        capture.images.prefetch(list(chosen[n + 1 : n + 3]))
        name = capture.views[index].name
        facts = _draw(draws, capture, rasterize, index, camera, step, background, folder, names[name], half)
        scored = score_files(folder, names[name], perceptual, device)
        captions = ("photograph", _caption(scored), f"error, 0 to {pictures.WORST:g}")
        _compose(folder, names[name], captions)
        per_view[name] = {"file": names[name], **scored, **facts}
        tell("rendering and scoring", n + 1, len(chosen))
    expert_pictures.write(folder, scene, cameras[0], step, rasterize, background)
    results = {
        "format": FORMAT,
        **_means(per_view, perceptual),
        **_scene_facts(scene, step),
        "gaussians_rendered": _mean(per_view, "gaussians_rendered"),
        "activation_ratio": _mean(per_view, "activation_ratio"),
        "fps": asdict(timing.measure(scene, cameras, step, rasterize, background)),
        **_views_scored(capture, cameras, options),
        **_about(about or About(), step, rasterize, perceptual),
        "evaluation_seconds": time.perf_counter() - began,
    }
    write_json(out / f"per_view{options.suffix}.json", per_view)
    write_json(out / f"results{options.suffix}.json", results)
    return results


def _perceptual(options: EvalOptions, device: torch.device, tell: Progress) -> Perceptual:
    """The LPIPS networks that can be used."""
    if not options.lpips:
        return Perceptual.off()
    fetching = lambda have, total: tell("fetching LPIPS weights, MiB", have >> 20, total >> 20)  # noqa: E731
    return Perceptual.find(options.lpips_weights, device, fetch=options.download_lpips, progress=fetching)


def _views_scored(capture: Capture, cameras: Sequence[Camera], options: EvalOptions) -> dict[str, Any]:
    return {
        "capture": capture.name,
        "views": options.views,
        **({"appearance": "half"} if options.appearance == "half" else {}),
        "view_count": len(cameras),
        "split": capture.split,
        "resolution": capture.resolution,
        "mean_pixels": round(sum(c.width * c.height for c in cameras) / len(cameras)),
    }


def _chosen(capture: Capture, options: EvalOptions) -> tuple[int, ...]:
    """The views to score. Raises InputError if there are none, or if the training views have codes already."""
    views = options.views
    chosen = capture.test if views == "test" else capture.train
    if not chosen:
        raise InputError(f"expected at least one {views} view in {capture.name}, found none (split {capture.split}); {EMPTY[views]}")
    if options.appearance == "half" and views == "train":
        raise InputError("expected held-out views for --appearance half, found --views train, which have codes; leave one of them out")
    return chosen


EMPTY = {
    "test": "train with another --split (for example mod8), or score the training views with --views train",
    "train": "choose another --split",
}


@torch.no_grad()
def _draw(
    draws: Draws,
    capture: Capture,
    rasterize: Rasterizer,
    index: int,
    camera: Camera,
    step: int,
    background: Tensor,
    folder: Path,
    file: str,
    half: bool = False,
) -> dict[str, Any]:
    """Draw one view and write it beside its photograph; what was counted on the way. half: only the right half counts."""
    frame = capture.frame(index)
    decoded = draws(camera, step, Mode.DRAW, rasterize.visible)
    render = rasterize(decoded.gaussians, camera, background)
    photo, drawn = frame.rgb.cpu().numpy(), pictures.to_8bit(render.image)
    if photo.shape != drawn.shape:
        raise InputError(
            f"expected {capture.views[index].name} as {drawn.shape[1]} x {drawn.shape[0]} px, found {photo.shape[1]} x {photo.shape[0]}; "
            f"load the capture again"
        )
    pictures.write(folder / "renders" / file, drawn)
    pictures.write(folder / "gt" / file, photo)
    mask = halves.right_mask(frame.mask, *photo.shape[:2]) if half else frame.mask
    if mask is not None:
        pictures.write(folder / "masks" / file, (mask.clamp(0, 1) * 255 + 0.5).to(torch.uint8).cpu().numpy())
    return view_facts(decoded, render)


def view_facts(decoded: Decoded, render: Render) -> dict[str, Any]:
    """Counts of one view. The activation ratio is the share of decoded Gaussians with positive opacity (MoE-GS, Table 3)."""
    raw = decoded.raw_opacity
    return {
        "anchors_visible": len(decoded.rows),
        "gaussians_decoded": len(decoded.gaussians),
        "gaussians_rendered": int((render.radii > 0).sum()),
        "activation_ratio": None if raw is None else float((raw > 0).double().mean()) if raw.numel() else 0.0,
    }


def score_files(folder: Path, file: str, perceptual: Perceptual, device: torch.device | str = "cpu") -> dict[str, Any]:
    """The scores of one view from its 8-bit files; empty where its mask counts nothing."""
    render, photo = (pictures.from_8bit(pictures.read(folder / kind / file)).to(device) for kind in ("renders", "gt"))
    path = folder / "masks" / file
    mask = pictures.from_8bit(pictures.read(path, "L")).to(device) if path.is_file() else None
    if mask is not None and not mask.any():
        return {}
    return {**score(render, photo, mask, perceptual), "masked": mask is not None}


def _compose(folder: Path, file: str, captions: tuple[str, str, str]) -> None:
    """Write the error map and the three pictures beside each other."""
    render, photo = pictures.read(folder / "renders" / file), pictures.read(folder / "gt" / file)
    mask = folder / "masks" / file
    errors = pictures.error_map(render, photo, pictures.read(mask, "L") if mask.is_file() else None)
    pictures.write(folder / "errors" / file, errors)
    pictures.write(folder / "side_by_side" / file, pictures.side_by_side(photo, render, errors, captions))


def _caption(scored: dict[str, Any]) -> str:
    if not scored:
        return "render"
    parts = [f"{scored['psnr']:.2f} dB", f"SSIM {scored['ssim']:.3f}"] + ([f"LPIPS {scored['lpips']:.3f}"] if "lpips" in scored else [])
    return "render  " + "  ".join(parts)


def _mean(per_view: dict[str, dict[str, Any]], key: str) -> float | None:
    values = [facts[key] for facts in per_view.values() if facts.get(key) is not None]
    return float(np.mean(values)) if values else None


def _means(per_view: dict[str, dict[str, Any]], perceptual: Perceptual) -> dict[str, Any]:
    """Unweighted means over views. A variant that even one view lacks is absent: null, with the reason beside it."""
    scored = {name: facts for name, facts in per_view.items() if "psnr" in facts}
    if not scored:
        raise InputError("expected masks that leave something to score, found none that do; check the capture's masks")
    absent = dict(perceptual.absent)
    means = {metric: None if metric in absent else _mean(scored, metric) for metric in VARIANTS}
    ours, theirs = _mean(scored, "sharpness") or 0.0, _mean(scored, "sharpness_photo") or 0.0
    return {
        **means,
        "absent": absent,
        "variants": VARIANTS,
        "masked": any(facts["masked"] for facts in scored.values()),
        "sharpness": {"render": ours, "photo": theirs, "ratio": ours / theirs if theirs > 0 else None},
    }


def sizes(scene: Scene) -> dict[str, Any]:
    """Bytes of the scene in its family's PLY file (float32 rows: 316 B an anchor for K = 10, F = 32; 248 B a Gaussian) and networks."""
    ply = 4 * scene.file_values * len(scene.table)
    networks = sum(tensor.numel() * tensor.element_size() for tensor in scene.network_tensors().values())
    total = ply + networks
    return {"ply_bytes": ply, "network_bytes": networks, "total_bytes": total, "MB": total / 1e6, "MiB": total / 2**20}


def _scene_facts(scene: Scene, step: int) -> dict[str, Any]:
    n = len(scene.table)
    return {
        "size": sizes(scene),
        "anchors": n,
        **({"anchors_by_level": scene.rows_by_level()} if scene.traits.levels else {}),
        "gaussians": n * scene.K,
        "experts": {attribute: asdict(found) for attribute, found in expert_shares(scene, step).items()},
    }


def _about(about: About, step: int, rasterize: Rasterizer, perceptual: Perceptual) -> dict[str, Any]:
    return {
        "recipe": about.recipe,
        "iterations": about.iterations or step,
        "step": step,
        "seed": about.seed,
        "train_seconds": about.train_seconds,
        "cpu_seconds": about.cpu_seconds,
        "load": about.load,
        "rasterizer": getattr(rasterize, "name", type(rasterize).__name__),
        "lpips_weights": perceptual.sources,
        "versions": {
            "training": about.versions,
            "evaluation": run_folder.versions(),
        },
    }
