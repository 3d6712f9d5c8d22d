"""What a reconstruction lacks, in sentences: photographs without a pose, why, and what to do."""

from __future__ import annotations

from typing import Any

from scene_experts.core.errors import few

MOST_REASONS = 8  # lines about photographs without a pose
LEAST = 12  # fewer photographs with a pose get a warning
FEW = 0.9  # a smaller share of photographs with a pose gets a warning


def explain_lacking(note: dict[str, Any], more: str) -> list[str]:
    """Return lines about the photographs without a pose, with advice; empty if nothing lacks.

    note: Content of capture.json. more: Options that compare all photographs with each other.
    """
    have, all_, without = note["with_pose"], note["photographs"], note["without_pose"]
    lines = []
    if without:
        lines.append(f"photographs without a pose: {few(without, 8)}")
    reasons: dict[str, list[str]] = {}
    for name, why in note.get("why", {}).items():
        reasons.setdefault(why, []).append(name)
    lines += [f"  {few(names, 4)}: {why}" for why, names in sorted(reasons.items(), key=lambda item: -len(item[1]))[:MOST_REASONS]]
    if note["apart"]:
        parts = ", ".join(map(str, note["apart"]))
        lines.append(f"warning: {parts} of these fit together, but not with the others; add photographs that connect them")
    if have < FEW * all_:
        more = "" if note["all_compared"] else f"; {more} may find more poses"
        lines.append(f"warning: every part of the scene should be sharp in at least three photographs from different positions{more}")
    if have < LEAST:
        lines.append(f"warning: {have} photographs show a small part of a scene; take 30 or more that overlap strongly")
    return lines
