"""Poses of the photographs by the mapper that finds more of them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from scene_experts.sfm.worker.mappers import MAPPERS
from scene_experts.sfm.worker.messages import report
from scene_experts.sfm.worker.missing import explain_missing

ENOUGH = 0.9  # fraction of photographs with a pose at which the second mapper is not tried


def estimate_poses(colmap: Any, ask: dict[str, Any]) -> dict[str, Any]:
    """Reconstruct the scene, write the best model and return a description of it. Its `lacking` are
    the photographs that the incremental mapper, or the only one, gave no pose."""
    total = sum(map(len, ask["groups"]))
    found: list[tuple[str, Any]] = []
    first: set[str] = set()
    tried: dict[str, int] = {}
    for mapper in ("incremental", "global") if ask["mapper"] == "auto" else (ask["mapper"],):
        out = Path(ask["maps"]) / mapper
        out.mkdir(parents=True)
        report(step=f"poses ({mapper})", done=0, total=total)
        try:
            models = MAPPERS[mapper](colmap, ask, str(out), total)
        except Exception as error:  # report it; the other mapper may succeed
            report(step="failed", mapper=mapper, why=str(error))
            tried[mapper] = 0
            continue
        found += [(mapper, model) for model in models.values()]
        tried[mapper] = max((model.num_reg_images() for model in models.values()), default=0)
        if len(tried) == 1 and models:
            first = registered_names(max(models.values(), key=lambda model: model.num_reg_images()))
        if tried[mapper] >= ENOUGH * total:
            break
        if mapper != ask["mapper"] and len(tried) == 1:
            report(step="next mapper", mapper=mapper, posed=tried[mapper], photographs=total, parts=len(models))
    lacking = sorted({name for group in ask["groups"] for name in group} - first)
    if not found:
        return {"registered": [], "lacking": lacking}
    mapper, best = max(found, key=lambda one: (one[1].num_reg_images(), one[1].num_points3D()))
    os.makedirs(ask["model"])
    best.write_binary(ask["model"])
    have = registered_names(best)
    others = [registered_names(model) - have for one, model in found if one == mapper]
    return {
        "mapper": mapper,
        "mappers": tried,
        "registered": sorted(have),
        "lacking": lacking,
        "why": explain_missing(colmap, ask, have, set().union(*others)),
        "apart": sorted(map(len, filter(None, others)), reverse=True),
        "points": best.num_points3D(),
        "error": best.compute_mean_reprojection_error(),
        "observations": best.compute_mean_observations_per_reg_image(),
        "cameras": [
            {"model": c.model.name, "width": c.width, "height": c.height, "params": [float(p) for p in c.params]}
            for c in best.cameras.values()
        ],
    }


def registered_names(model: Any) -> set[str]:
    """Return the names of the photographs that have a pose in a model."""
    return {model.images[i].name for i in model.reg_image_ids()}
