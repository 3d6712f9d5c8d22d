"""The list of all photographs of a run, the worst first, the worst of them beside their renders."""

from __future__ import annotations

from html import escape

from scene_experts.core.reading.source import inside
from scene_experts.evaluate.photographs import WORST, Photograph
from scene_experts.report.source import ShownRun
from scene_experts.report.views import encode_picture

LONGEST = 360  # px; the pictures of the list are at most this large
ABOUT = (
    "Every photograph of the run; those that lie furthest below the median of their part of the split come first, because held-out views "
    "always score lower than training views. Training views are drawn at a reduced size. Photographs that fit far worse than the others "
    "are marked: one with another exposure, a finger or a wrong pose can be left out of a new training with --leave-out NAME."
)


def list_photographs(s: ShownRun, most: int = WORST) -> str:
    """Return the list as HTML; the `most` worst photographs have pictures, if the run has them."""
    without = "" if any(each.part == "training" for each in s.photographs) else " Evaluate the run again to list its training views."
    shown = [figure for each in s.photographs[:most] if (figure := _show(s, each))]
    rows = "".join(
        f"<tr{' class=bad' if each.outlier else ''}><td>{escape(each.name)}</td><td>{each.part}</td><td>{each.psnr:.2f}</td>"
        f"<td>{each.psnr - each.median:+.2f}</td></tr>"
        for each in s.photographs
    )
    head = "<tr><th scope=col>photograph</th><th scope=col>part</th><th scope=col>PSNR</th><th scope=col>from the median</th></tr>"
    table = f"<div class='wide' tabindex=0><table>{head}{rows}</table></div>"
    return (
        f"<p class='soft'>{ABOUT}{without}</p><div class='pairs'>{''.join(shown)}</div>"
        f"<details><summary>all {len(s.photographs)} photographs</summary>{table}</details>"
    )


def _show(s: ShownRun, each: Photograph) -> str:
    pair = [inside(s.path / each.folder / kind, each.file) for kind in ("gt", "renders")]
    if not all(path.is_file() for path in pair):
        return ""
    images = "".join(
        f"<img alt='{escape(each.name)}, {what}' src='{encode_picture(path, LONGEST)}'>"
        for what, path in zip(("photograph", "render"), pair)
    )
    tag = "<span class=tag>fits badly</span> " if each.outlier else ""
    facts = f"{each.part}, {each.psnr:.1f} dB, median {each.median:.1f}"
    return f"<figure><div>{images}</div><figcaption>{tag}{escape(each.name)} <span class='soft'>{facts}</span></figcaption></figure>"
