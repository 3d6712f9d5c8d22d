"""The held-out views of the page: photograph, renders and errors under a slider, the best and the
worst view first."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from html import escape
from pathlib import Path
from statistics import fmean

from PIL import Image

from scene_experts.evaluate.pictures import read_picture
from scene_experts.report.source import ShownRun, find_common_views

MOST_VIEWS = 8  # of a capture; pictures are most of a page's bytes
LONGEST = 960  # px; larger pictures are scaled down
QUALITY = 88  # of the JPEGs


def show_captures(groups: dict[str, list[ShownRun]]) -> tuple[str, dict[str, str]]:
    """Return the held-out views of each capture as HTML, and their pictures as data URLs by key."""
    pictures: dict[str, str] = {}
    parts = []
    for i, (capture, group) in enumerate(groups.items()):
        views, shown = show_views(group, f"{i}.")
        pictures |= shown
        if len(groups) > 1:
            parts.append(f"<h3>{escape(capture)}</h3>")
        why = "no pictures in the run folder" if find_common_views(group) else "no view that all of these runs were scored on"
        parts.append(f"<div class='views'>{views}</div>" if views else f"<p>{why}</p>")
    return "\n".join(parts), pictures


def show_views(sources: Sequence[ShownRun], prefix: str) -> tuple[str, dict[str, str]]:
    """Return up to MOST_VIEWS views with their sliders as HTML, and their pictures as data URLs by
    key. Keys start with `prefix`."""
    pictures: dict[str, str] = {}
    blocks = []
    names = find_common_views(sources)
    for n, (name, tag) in enumerate(choose_shown(sources, names)):
        options = [("photograph", sources[0].pictures / "gt" / sources[0].per_view[name]["file"])]
        options += [(s.name, s.pictures / "renders" / s.per_view[name]["file"]) for s in sources]
        options += [(f"{s.name}, error", s.pictures / "errors" / s.per_view[name]["file"]) for s in sources]
        present = [(label, path) for label, path in options if path.is_file()]
        if len(present) < 2:
            continue
        for i, (_, path) in enumerate(present):
            pictures[f"{prefix}{n}.{i}"] = encode_picture(path)
        scores = ", ".join(f"{s.name} {s.per_view[name]['psnr']:.2f} dB" for s in sources if "psnr" in s.per_view[name])
        pick = [
            "".join(
                f"<option value='{prefix}{n}.{i}'{' selected' if i == wanted else ''}>{escape(label)}</option>"
                for i, (label, _) in enumerate(present)
            )
            for wanted in (0, 1)
        ]
        blocks.append(
            f"<div class='view'><div class='pick'>{f'<span class=tag>{tag}</span>' if tag else ''}<b>{escape(name)}</b>"
            f"<span class='soft'>{escape(scores)}</span>"
            f"<label>left <select>{pick[0]}</select></label><label>right <select>{pick[1]}</select></label></div>"
            f"<div class='stage'><img alt='{escape(name)}, left'><img class='over' alt='{escape(name)}, right'>"
            "<span class='edge'></span></div>"
            f"<input type='range' min='0' max='100' value='50' aria-label='boundary between the two pictures'></div>"
        )
    return "\n".join(blocks), pictures


def encode_picture(path: Path, longest: int = LONGEST) -> str:
    """Return a picture as the data URL of a JPEG of at most `longest` px a side. Raises InputError
    if it is unreadable."""
    picture = Image.fromarray(read_picture(path))
    picture.thumbnail((longest, longest), Image.Resampling.LANCZOS)
    stream = io.BytesIO()
    picture.save(stream, format="JPEG", quality=QUALITY)
    return f"data:image/jpeg;base64,{base64.b64encode(stream.getvalue()).decode()}"


def choose_shown(sources: Sequence[ShownRun], names: Sequence[str]) -> list[tuple[str, str]]:
    """Return up to MOST_VIEWS views as (name, label): the best and the worst by mean PSNR over the
    runs, then others in order."""
    scores = {n: [s.per_view[n]["psnr"] for s in sources if s.per_view[n].get("psnr") is not None] for n in names}
    scored = sorted((name for name in names if scores[name]), key=lambda name: fmean(scores[name]))
    ends = [(scored[-1], "best view"), (scored[0], "worst view")] if len(scored) > 1 else []
    others = [name for name in names if name not in dict(ends)]
    step = max(1, -(-len(others) // max(1, MOST_VIEWS - len(ends))))
    return [*ends, *((name, "") for name in others[::step])]
