"""Compute the configuration hash of older checkpoints, so that their runs can resume. Newer checkpoints store the configuration.

This file must not change. Settings that are newer than the hash count only if they differ from their defaults.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from typing import Any

from scene_experts.core.plain import to_json

_ANCHOR_GROWTH = "start_stat adjust grad_threshold success_threshold min_opacity scale_clamp max_anchors enabled"
_LATTICE_GROWTH = f"{_ANCHOR_GROWTH} levels init_factor hierarchy_factor elimination parity_level_skip"
_EXPERTS = "num top_k warmup attributes mix expert_init load_scope form router"
_FIELDS = {
    "Train": "recipe scene loss growth rates iterations seed antialias random_background max_anchors",
    "Anchors": "K F hidden add_dist voxel_size voxel_rule quat_align decode decoder",
    "Plain": "depth",
    "Experts": _EXPERTS,
    "BalancedExperts": f"{_EXPERTS} speed",
    "Router": "bias init renormalise noise_std detach_feature input_pos",
    "FeatureBank": "hidden",
    "Octree": "fork count first base_layer coarseness dist_ratio visible_threshold rule coarse_to_fine coarse_until coarse_factor extend "
    "parity_cube",
    "Explicit": "sh_degree sh_ramp opacity size",
    "GraphPoints": "F hidden offset_hidden neighbours blend low high flat_sigmas voxel_size voxel_rule grid",
    "HashGrid": "levels features log2_table base growth coordinates",
    "Weights": "dssim scale opacity load tau opacity_scope load_reduce load_phase load_normalise_by_k opacity_from opacity_until",
    "GrowAnchors": _LATTICE_GROWTH,
    "GrowPoints": f"{_LATTICE_GROWTH} visits",
    "GrowOctree": f"{_ANCHOR_GROWTH} update_ratio extra_ratio extra_up parity_coarse_gate parity_extra_level",
    "SplitClone": "adjust grad_threshold dense_size min_opacity max_size reset reset_least reset_opacity reset_at_start "
    "max_anchors enabled",
    "MCMC": "adjust min_opacity growth noise max_anchors enabled",
    "Rates": "feature offsets log_scaling opacity cov color router_scale",
    "ExplicitRates": "means log_scales quats raw_opacity sh_dc sh_rest",
    "GraphRates": "feature log_scaling opacity cov color offsets grid affine",
    "Every": "start stop interval",
    "Rate": "first last",
}


def old_hash(cfg: Any) -> str:
    """Return the hash of a scaled `Train` value, as older versions stored it in checkpoints."""
    return hashlib.sha256(json.dumps(_plain(cfg), sort_keys=True).encode()).hexdigest()[:16]


def _plain(value: Any) -> Any:
    """Convert a value as `to_json` does, without newer fields that have their default value."""
    if not dataclasses.is_dataclass(value):
        return to_json(value)
    counted = _FIELDS.get(type(value).__name__, "").split()
    fields = [f for f in dataclasses.fields(value) if f.name in counted or getattr(value, f.name) != f.default]
    return {"type": type(value).__name__, **{f.name: _plain(getattr(value, f.name)) for f in fields}}
