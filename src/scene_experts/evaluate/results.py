"""results.json: what it states about an evaluation, how it is read back, and when the scores of two
runs may be compared."""

from __future__ import annotations

import hashlib
import json
import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from itertools import combinations
from pathlib import Path
from statistics import fmean, median_high
from typing import TYPE_CHECKING, Any

import numpy as np

from scene_experts.core.errors import InputError, few
from scene_experts.core.fields import flag_of
from scene_experts.core.io import read_json
from scene_experts.core.types import Camera
from scene_experts.data.views import same_poses
from scene_experts.evaluate.alignment import ALIGNED
from scene_experts.evaluate.experts import measure_scene_shares
from scene_experts.evaluate.metrics import OF_MASKED, VARIANTS, Perceptual
from scene_experts.evaluate.options import EvalOptions
from scene_experts.training import run_folder

if TYPE_CHECKING:
    from scene_experts.data.capture import Capture
    from scene_experts.render import Rasterizer
    from scene_experts.scene import Scene

FAILED = 6.0  # dB below the median of the views: such a view fails
PROTOCOL = {  # what must agree before scores may be compared: key in results.json, name, option that sets it
    "capture": ("capture", "data"),
    "resolution": ("resolution", "resolution"),
    "split": ("split", "split"),
    "left_out": ("photographs left out", "leave_out"),
    "views": ("views", "views"),
    "view_count": ("number of views", "max_views"),
    "scored": ("scored photographs", "split"),
    "photographs": ("files of photographs and masks", "data"),
    "mean_pixels": ("picture size", "resolution"),  # after the views: those of another split may have other sizes
    "appearance": ("appearance codes", "appearance"),
    "alignment": ("alignment of held-out cameras", "align_poses"),
    "masked": ("use of masks", "data"),
    "background": ("background of transparent photographs", "background"),
}
DEFAULTS = {"appearance": "rule", "left_out": [], "alignment": "none"}  # the meaning of a results file without the key
MAY_LACK = ("background", "scored", "photographs")  # a results file without one of these agrees with every other


@dataclass(frozen=True)
class About:
    """The training of the run, for the results file."""

    recipe: str = ""
    iterations: int = 0  # of the schedule
    seed: int = 0
    train_seconds: float = 0.0  # wall time of the training loop, without saving and previews
    versions: dict[str, str] = field(default_factory=dict)  # of the libraries during the training
    cpu_seconds: float | None = None  # CPU time of the training loop; None: unknown
    load: dict[str, float | None] = field(default_factory=dict)  # of the machine during the training, see `Clock.load`


def mean_over_views(per_view: dict[str, dict[str, Any]], key: str) -> float | None:
    """Return the unweighted mean of a value over the views that have it, or None if none has it."""
    values = [facts[key] for facts in per_view.values() if facts.get(key) is not None]
    return float(np.mean(values)) if values else None


def describe_scores(per_view: dict[str, dict[str, Any]], perceptual: Perceptual) -> dict[str, Any]:
    """Return the mean scores. A variant that is absent for any view is null, and `absent` states
    the reason.

    Raises InputError if masks exclude every pixel of every view.
    """
    scored = {name: facts for name, facts in per_view.items() if "psnr" in facts}
    if not scored:
        raise InputError("expected masks that leave pixels to score, found none; check the capture's masks")
    masked = any(facts["masked"] for facts in scored.values())
    absent = dict(perceptual.absent)
    means = {metric: None if metric in absent else mean_over_views(scored, metric) for metric in VARIANTS}
    ours, theirs = mean_over_views(scored, "sharpness") or 0.0, mean_over_views(scored, "sharpness_photo") or 0.0
    return {
        **means,
        "absent": absent,
        "variants": {metric: f"{about}; {OF_MASKED[metric]}" for metric, about in VARIANTS.items()} if masked else VARIANTS,
        "masked": masked,
        "psnr_aligned": mean_over_views(scored, "psnr_aligned"),
        "detail": mean_over_views(scored, "detail"),
        "sharpness": {"render": ours, "photo": theirs, "ratio": ours / theirs if theirs > 0 else None},
    }


def describe_size(scene: Scene) -> dict[str, Any]:
    """Return the sizes in bytes of the scene in its family's PLY file and of its networks, and the
    total in MB and MiB.

    A row has float32 values: 316 bytes per anchor for K = 10 and F = 32, 248 bytes per Gaussian.
    """
    ply = 4 * scene.file_values * len(scene.table)
    networks = sum(tensor.numel() * tensor.element_size() for tensor in scene.network_tensors().values())
    total = ply + networks
    return {"ply_bytes": ply, "network_bytes": networks, "total_bytes": total, "MB": total / 1e6, "MiB": total / 2**20}


def describe_scene(scene: Scene, step: int) -> dict[str, Any]:
    """Return the size of the scene, the numbers of its rows and Gaussians, and the shares of its
    experts."""
    rows = len(scene.table)
    return {
        "size": describe_size(scene),
        "anchors": rows,
        **({"anchors_by_level": scene.rows_by_level()} if scene.traits.levels else {}),
        "gaussians": rows * scene.K,
        "experts": {attribute: asdict(found) for attribute, found in measure_scene_shares(scene, step).items()},
    }


def describe_views(capture: Capture, cameras: Sequence[Camera], options: EvalOptions, aligned: bool = False) -> dict[str, Any]:
    """Return which views were scored, and the choices that make scores comparable. aligned: the
    cameras were first aligned with the scene."""
    return {
        "capture": capture.name,
        "views": options.views,
        **({"appearance": "half"} if options.appearance == "half" else {}),
        "view_count": len(cameras),
        "split": capture.split,
        **({"alignment": ALIGNED} if aligned else {}),
        **({"left_out": list(capture.omitted)} if capture.omitted else {}),
        "resolution": capture.resolution,
        "mean_pixels": round(sum(c.width * c.height for c in cameras) / len(cameras)),
        **({} if capture.alpha_over is None else {"background": list(capture.alpha_over)}),
        "poses": capture.poses(),
        "scored": hash_names([capture.views[camera.id].name for camera in cameras]),
        "photographs": capture.photographs(),
        **({} if capture.points is None else {"points": len(capture.points.xyz)}),  # those of other poses are others
    }


def hash_names(names: Sequence[str]) -> str:
    """Return a short hash of names, whatever their order."""
    return hashlib.sha256(json.dumps(sorted(names)).encode()).hexdigest()[:16]


def describe_run(about: About, step: int, rasterize: Rasterizer, perceptual: Perceptual) -> dict[str, Any]:
    """Return how the scene was trained, and with what it was drawn and scored."""
    return {
        "recipe": about.recipe,
        "iterations": about.iterations or step,
        "step": step,
        "seed": about.seed,
        "train_seconds": about.train_seconds,
        "cpu_seconds": about.cpu_seconds,
        "load": about.load,
        "rasterizer": rasterize.name,
        "lpips_weights": perceptual.sources,
        "versions": {"training": about.versions, "evaluation": run_folder.versions()},
    }


def find_failed(per_view: dict[str, dict[str, Any]]) -> list[str]:
    """Return the names of the views whose PSNR is more than FAILED below the (upper) median of all,
    the worst first."""
    scored = {name: facts["psnr"] for name, facts in per_view.items() if isinstance(facts.get("psnr"), (int, float))}
    if not scored:
        return []
    least = median_high(scored.values()) - FAILED
    return sorted((name for name, psnr in scored.items() if psnr < least), key=lambda name: scored[name])


def describe_failed(per_view: dict[str, dict[str, Any]]) -> str:
    """Return a sentence about the views that fail, or "" if there are none."""
    failed = find_failed(per_view)
    if not failed:
        return ""
    scored = {name: facts["psnr"] for name, facts in per_view.items() if "psnr" in facts}
    kept = [psnr for name, psnr in scored.items() if name not in failed]
    named = few([f"{name} ({scored[name]:.1f} dB)" for name in failed])
    verb = "fails" if len(failed) == 1 else "fail"
    return (
        f"{len(failed)} of {len(scored)} views {verb}: {named}; the others have {fmean(kept):.1f} dB on average. Look at their pictures: "
        "a failing view often has a wrong pose, is blurred, has other light, or shows what no training photograph shows"
    )


def command_of(run: Path) -> str:
    """Return the command that scores a run."""
    return shlex.join(["scene-experts", "eval", str(run)])


def results_file(run: Path) -> Path:
    """Return the place of the results of a run folder: those of its training views if only these were
    scored, because it holds none out."""
    held, trained = run / "results.json", run / "results_train.json"
    return trained if trained.is_file() and not held.is_file() else held


def load_results(run: Path, training: bool = False) -> dict[str, Any]:
    """Read results.json of a run folder, or a file of results. Raises InputError if the run was not
    evaluated.

    training: Whether those of the training views do for a run that holds none out.
    """
    if not run.exists():
        raise InputError(f"expected a run folder at {run}, found nothing; correct the path")
    path = run if run.is_file() else results_file(run) if training else run / "results.json"
    if not path.is_file():
        raise InputError(f"expected an evaluated run with {path.name} in {run}, found none; run `{command_of(run)}` first")
    results = read_json(path, "results file")
    if not isinstance(results, dict) or not isinstance(results.get("psnr"), (int, float)):
        raise InputError(f"expected results of `scene-experts eval` in {path}, found something else; evaluate the run again")
    step = results.get("step")
    if not isinstance(step, (int, type(None))) or isinstance(results["psnr"], bool):
        raise InputError(f"expected numbers in {path}, found others; evaluate the run again")
    return results


def find_outdated(names: Sequence[str], runs: Sequence[Path], results: Sequence[dict[str, Any]]) -> list[str]:
    """Return a sentence for each run that was trained further after it was scored."""
    out = []
    for name, run, found in zip(names, runs, results):
        newest = max((int(p.stem[5:]) for p in (run / "checkpoints").glob("ckpt_*.safetensors") if p.stem[5:].isdecimal()), default=0)
        if newest > (found.get("step") or newest):
            out.append(f"{name} was scored at iteration {found['step']:,} and is at {newest:,} now: run `{command_of(run)}` again")
    return out


def find_difference(names: Sequence[str], results: Sequence[dict[str, Any]]) -> tuple[str, str] | None:
    """Return the first difference in what was scored, in words, and the option that sets it; None
    if scores may be compared."""
    for (first, one), (second, other) in combinations(zip(names, results), 2):
        for key, (what, option) in PROTOCOL.items():
            if key in MAY_LACK and not (key in one and key in other):
                continue
            ours, theirs = (r.get(key, DEFAULTS.get(key)) for r in (one, other))
            if ours != theirs:
                return f"the same {what}, found {ours} in {first} and {theirs} in {second}", flag_of(option)
        if not same_poses(one.get("poses"), other.get("poses")):
            return f"the same camera poses, found others in {second} than in {first}", flag_of("data")
    return None


def check_protocol(names: Sequence[str], results: Sequence[dict[str, Any]]) -> None:
    """Raise InputError with the first difference in what was scored. The resolution alone changes
    PSNR by up to 0.5 dB."""
    if found := find_difference(names, results):
        raise InputError(
            f"expected runs with {found[0]}; repeat one with the {found[1]} of the other, or compare them nevertheless with --mixed"
        )
