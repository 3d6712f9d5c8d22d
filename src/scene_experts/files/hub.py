"""A folder for a model hub: a trained scene in several formats, a picture, and a card (README.md)
that hubs read.

The card begins with YAML: licence, tags, and the scores of `scene-experts eval` where the run was
evaluated at this iteration. Whoever publishes a scene must know the licence of its photographs:
licence texts beside them are copied, and the card says where none was stated.
"""

from __future__ import annotations

import logging
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
import yaml

from scene_experts.core.errors import InputError
from scene_experts.core.io import check_writable, write_bytes
from scene_experts.core.reading import budget
from scene_experts.core.reading.source import opening
from scene_experts.core.version import __version__
from scene_experts.data.capture import Capture
from scene_experts.evaluate.alignment import ALIGNED_SHORT
from scene_experts.evaluate.pictures import to_8bit, write_picture
from scene_experts.evaluate.results import load_results
from scene_experts.files import registry
from scene_experts.files.export import export_several
from scene_experts.files.measure import Painter, Tell, capture_if_there
from scene_experts.files.options import DEFAULT, Options
from scene_experts.files.registry import GAUSSIANS, format_named, formats_of
from scene_experts.files.standard import Written
from scene_experts.training.run_folder import OpenRun
from scene_experts.view.paths import choose_best_view

log: logging.Logger = logging.getLogger(__name__)
CARD, PREVIEW = "README.md", "preview.png"
_OWN = b"library_name: scene-experts"  # in the head of a card of ours
UNKNOWN = "unknown"
METRICS = {"psnr": "PSNR, dB", "ssim": "SSIM", "lpips": "LPIPS"}
_NOTICES = ("LICENSE*", "LICENCE*", "ATTRIBUTION*", "NOTICE*")  # in a capture's folder
_LONGEST = 1 << 20  # bytes of such a text


def default_formats(run: OpenRun) -> tuple[str, ...]:
    """The formats of a folder for which none was chosen: the small one that keeps the networks,
    where the family has one, and SPZ."""
    return ("compact", "spz") if "compact" in formats_of(run.scene.traits.family, ("compact",)) else ("spz",)


def write_hub(
    run: OpenRun,
    folder: Path,
    formats: Sequence[str] = (),
    options: Options = DEFAULT,
    *,
    licence: str = UNKNOWN,
    tell: Tell = lambda what, done, total: None,
    command: str = "",
) -> list[Written]:
    """Write a folder for a model hub.

    Args:
        run: The run, on the CPU. The picture needs its capture.
        folder: Folder to write; files of the same names are replaced.
        formats: Names of formats; none for `default_formats`.
        options: What the files hold, as for `export`.
        licence: Licence of the photographs and so of the scene, as hubs name it: "mit",
            "cc-by-4.0".
        tell: Called with the progress: what, done, total.
        command: The command line, kept in the files' notes.

    Returns:
        One `Written` per scene file.

    Raises:
        InputError: `folder` is a file, the capture is missing, or a format cannot hold the scene.
        RunError: The disk is full.
    """
    if folder.is_file():
        raise InputError(f"expected a folder for --hub, found the file {folder}; name a folder")
    if (folder / CARD).exists() and not _is_own_card(folder / CARD):
        raise InputError(f"expected no {CARD} in {folder}, or one that export wrote, found another; move it away, or name another folder")
    folder.mkdir(parents=True, exist_ok=True)
    check_writable(folder / CARD)
    with capture_if_there(run, needed=True) as capture:
        assert capture is not None
        notices = copy_notices(capture.root, folder)
        write_picture(folder / PREVIEW, draw_preview(run, capture))
    names = tuple(formats) or default_formats(run)
    written = export_several(run, names, folder, options, tell=tell, command=command)
    imports = options.frame == "capture" or any(format_named(name).family != GAUSSIANS for name in names)
    write_bytes(folder / CARD, make_card(run, written, find_scores(run), licence, notices, imports).encode())
    return written


def _is_own_card(path: Path) -> bool:
    """Return whether `export` wrote a card."""
    with opening(path, budget.NOTE) as source:
        return _OWN in source.head(registry.HEAD)


def find_scores(run: OpenRun) -> dict[str, Any]:
    """The content of results.json; empty where the run was not evaluated. Scores of another
    iteration are left out, with a warning."""
    try:
        scores = load_results(run.path)
    except InputError:
        return {}
    step = scores.get("step")
    if step in (None, run.step):
        return scores
    again = shlex.join(["scene-experts", "eval", str(run.path), "--step", str(run.step)])
    log.warning("the card has no scores: the run was scored at iteration %s, its files are of %s; run `%s` first", step, run.step, again)
    return {}


@torch.no_grad()
def draw_preview(run: OpenRun, capture: Capture) -> Any:
    """The picture of the view that shows the capture best, uint8 [H, W, 3]."""
    camera = capture.views[choose_best_view(capture)].camera
    painter = Painter.of(run.scene, run.step, antialias=run.config.train.antialias)
    return to_8bit(painter.picture(camera, torch.tensor(capture.background)))


def copy_notices(capture: Path, folder: Path) -> list[str]:
    """Copy the licence texts of a capture's folder as CAPTURE_NAME; return their new names."""
    found = sorted({path for pattern in _NOTICES for path in capture.glob(pattern) if path.is_file() and path.stat().st_size <= _LONGEST})
    names = []
    for path in found:
        with opening(path, budget.NOTE) as source:
            write_bytes(folder / f"CAPTURE_{path.name}", source.read())
        names.append(f"CAPTURE_{path.name}")
    return names


def make_card(
    run: OpenRun, files: Sequence[Written], scores: dict[str, Any], licence: str, notices: Sequence[str], imports: bool = True
) -> str:
    """The text of the card. scores: the content of results.json, or empty. imports: whether
    `import` reads the first of the files, or the result folder that it is in."""
    recipe, scene = run.config.train.recipe, run.config.data.path.name or "scene"
    metrics = [{"type": name, "name": title, "value": round(float(scores[name]), 4)} for name, title in METRICS.items() if scores.get(name)]
    head: dict[str, Any] = {
        "license": licence,
        "library_name": "scene-experts",
        "pipeline_tag": "image-to-3d",
        "tags": list(dict.fromkeys(["3d", "gaussian-splatting", "novel-view-synthesis", "scene-experts", recipe])),
    }
    if metrics:
        task = {"type": "image-to-3d", "name": "novel view synthesis"}
        name = f"held-out views of {scene}{f', {ALIGNED_SHORT}' if scores and scores.get('alignment') else ''}"
        result = {"task": task, "dataset": {"type": scene, "name": name}, "metrics": metrics}
        head["model-index"] = [{"name": f"{scene}, {recipe}", "results": [result]}]
    lines = ["---", yaml.safe_dump(head, sort_keys=False, allow_unicode=True).strip(), "---", "", f"# {scene}", ""]
    maker = f"scene-experts {__version__}"
    lines += [f"![{scene}]({PREVIEW})", "", f"A 3D scene of Gaussians, trained from photographs by {maker} with"]
    lines += [f"the recipe `{recipe}` for {run.step:,} iterations.", "", "| file | content |", "|---|---|"]
    for file in files:
        folder, format = file.path.is_dir(), format_named(file.format)  # a folder: point_cloud/iteration_N of a result folder
        name = f"`{file.path.parent.name}/{file.path.name}`" if folder else f"`{file.path.name}`"
        name += f", `{file.path.stem}.parts`" if format.size is not None and file.path.suffix == ".html" else ""
        kind = "Gaussians" if format.family == GAUSSIANS else f"{run.scene.traits.rows} with their networks"
        content = "a mesh" if format.draw is not None else f"{file.rows:,} {kind}"
        lines.append(f"| {name} | {content}, {file.bytes / 1e6:.1f} MB |")
    lines += ["", "## Open it", ""]
    readable = [file for file in files if file.path.is_dir() or format_named(file.format).read is not None]
    if imports and readable:
        lines += ["```sh", "pip install scene-experts"]
        lines += ["# CAPTURE: folder of its photographs with poses; the run can be drawn, scored and converted"]
        lines += [f"scene-experts import {'.' if readable[0].path.is_dir() else readable[0].path.name} --data CAPTURE --out RUN"]
        lines += ["```", ""]
    elif not imports:
        lines += ["The Gaussians are in the frame that the scene was trained in, not in that of its photographs.", ""]
    if any(file.path.suffix == ".spz" for file in files):
        lines += ["Viewers of Gaussian splats open the `.spz` file directly.", ""]
    if metrics:
        views = f"{scores.get('view_count', 'the')} held-out views"
        resolution, split = scores.get("resolution", "unknown"), scores.get("split", "unknown")
        fitted = f" ({ALIGNED_SHORT})" if scores.get("alignment") else ""
        about = f"Means over {views}{fitted} (split `{split}`, resolution `{resolution}`), of the scene with its networks:"
        lines += ["## Scores", "", about, ""]
        lines += ["| metric | value |", "|---|---|", *(f"| {metric['name']} | {metric['value']} |" for metric in metrics), ""]
    lines += ["## Licence", ""]
    if licence == UNKNOWN:
        lines += ["The licence of the photographs was not stated. Ask their owner before you use this scene.", ""]
    else:
        lines += [f"The scene has the licence of its photographs: {licence}.", ""]
    if notices:
        lines += [f"Texts that came with the photographs: {', '.join(f'[{name}]({name})' for name in notices)}.", ""]
    return "\n".join(lines)
