"""Checks that the tensors and metadata of a foreign checkpoint fit the settings of its scene,
before the scene is built.

A scene indexes its columns without further checks, and its settings decide how much memory its
networks take.
"""

from __future__ import annotations

import math
from typing import Any, get_args

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from scene_experts.core.fields import check_fields
from scene_experts.core.reading.budget import Damaged
from scene_experts.core.reading.numbers import FARTHEST, all_finite, expect_range, number, shown, whole_number
from scene_experts.scene import Scene, SceneConfig, restore_scene
from scene_experts.scene.anchors.levels import MOST_FORK, MOST_LEVELS, LevelRule
from scene_experts.scene.anchors.quantise import CLASS, HIGH_CLASS, KEEP, LOW_CLASS

_CREATE = (torch.empty, torch.zeros, torch.ones, torch.full, torch.rand, torch.randn)

_MOST_FLOAT32 = torch.finfo(torch.float32).max
MOST_STEPS = 1 << 40  # iterations of a training


def check_fit(config: SceneConfig, tensors: dict[str, Tensor], meta: dict[str, Any]) -> None:
    """Check tensors and metadata of a checkpoint against the settings of its scene. Allocates
    nothing of their size.

    Raises Damaged for columns of other shapes or types, values that are not finite, metadata out of
    range, and settings that ask for larger networks than the stored ones; InputError for invalid
    settings.
    """
    check_fields(config, "scene")
    number(meta["extent"], "the extent", 1e-15, FARTHEST)
    number(meta.get("voxel", 0.0), "the edge of a cell", 0, FARTHEST)
    whole_number(meta.get("step", 0), "the iteration", 0, MOST_STEPS)
    columns = {name: value for name, value in tensors.items() if name.startswith(("params.", "facts."))}
    check_columns(config.shapes(), columns)
    for name, value in tensors.items():
        if name.startswith(("params.", "facts.", "network.", "average.")) and not all_finite(value):
            raise Damaged(f"values that are not finite in {name}")
        if value.is_complex():
            raise Damaged(f"complex numbers in {name}")
        if value.dtype == torch.float64:  # it becomes float32
            expect_range(value, name, -_MOST_FLOAT32, _MOST_FLOAT32)
    if "levels" in meta:
        check_levels(meta["levels"], columns.get("facts.level"))


def restore_foreign(config: SceneConfig, tensors: dict[str, Tensor], meta: dict[str, Any], averaged: bool = False) -> Scene:
    """Build the scene of a checkpoint as `restore_scene` does, after `check_fit`.

    Raises Damaged also for settings that ask for larger networks than the stored ones, before their
    memory is allocated.
    """
    check_fit(config, tensors, meta)
    stored = [value for name, value in tensors.items() if name.startswith("network.")]
    experts = sum(len(value) for value in stored if value.dim() == 3)  # of the layers of all heads; each is initialised on its own
    with _Limited(20_000 + 200 * len(stored) + 20 * experts, 2 * sum(value.numel() for value in stored) + (1 << 20)):
        return restore_scene(config, tensors, meta, averaged)


def check_columns(shapes: dict[str, tuple[int, ...]], columns: dict[str, Tensor]) -> None:
    """Raise Damaged unless the columns have these shapes after the first axis, one length, and the
    type that their names imply."""
    lengths = {len(value) if value.dim() else -1 for value in columns.values()}
    if len(lengths) > 1 or -1 in lengths or (shapes and not columns):
        raise Damaged("columns of different lengths, or none")
    for name, shape in shapes.items():
        if name not in columns or tuple(columns[name].shape[1:]) != shape:
            found = list(columns[name].shape) if name in columns else "none"
            raise Damaged(f"{name} of shape {found} where [N{''.join(f', {n}' for n in shape)}] is expected")
        whole = name in ("facts.cell", "facts.level")
        if columns[name].dtype != torch.int64 if whole else not columns[name].is_floating_point():
            raise Damaged(f"{name} of type {columns[name].dtype}")
    slots = shapes.get("params.offsets", (0,))[:1]
    optional = {"facts.interval": (), "facts.slots": slots, f"params.{KEEP}": slots, f"facts.{CLASS}": ()}  # of anchors
    for name in optional.keys() & columns.keys():
        kind = {"facts.slots": torch.bool, f"facts.{CLASS}": torch.int64}.get(name)
        fits = columns[name].is_floating_point() if kind is None else columns[name].dtype == kind
        if not fits or tuple(columns[name].shape[1:]) != optional[name]:
            raise Damaged(f"{name} of shape {list(columns[name].shape)} and type {columns[name].dtype}")
    classes = columns.get(f"facts.{CLASS}", torch.zeros(1))
    if classes.numel() and not LOW_CLASS <= int(classes.min()) <= int(classes.max()) <= HIGH_CLASS:
        raise Damaged(f"step classes out of {LOW_CLASS} to {HIGH_CLASS}")
    if f"params.{KEEP}" in columns and f"facts.{CLASS}" not in columns:
        raise Damaged("masks without step classes")


def check_levels(meta: dict[str, Any], level: Tensor | None) -> None:
    """Raise Damaged for levels of detail out of range, and for rows on other levels."""
    count = whole_number(meta["count"], "the number of levels", 1, MOST_LEVELS)
    whole_number(meta["first"], "the first levels", 0, count)
    whole_number(meta["fork"], "the fork of levels", 2, MOST_FORK)
    for name, low in (("edge", 1e-15), ("standard", 1e-15), ("threshold", -FARTHEST)):
        number(meta[name], f"the {name} of levels", low, FARTHEST)
    if meta["rule"] not in get_args(LevelRule):
        raise Damaged(f"{shown(meta['rule'])} as the rule of levels")
    for place in (meta["origin"], *meta["cameras"]):
        if len([number(v, "a position", -FARTHEST, FARTHEST) for v in place]) != 3:
            raise Damaged("a position of another number of coordinates")
    if level is None or (level.numel() and not 0 <= int(level.min()) <= int(level.max()) < count):
        raise Damaged(f"rows on other levels than 0 to {count - 1}")


class _Limited(TorchFunctionMode):
    """Raises Damaged after `calls` calls of torch, and before torch creates a tensor of over
    `values` values."""

    def __init__(self, calls: int, values: int) -> None:
        super().__init__()
        self.calls, self.values = calls, values

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.calls -= 1
        if self.calls < 0 or (func in _CREATE and math.prod(_sizes(args)) > self.values):
            raise Damaged("settings of larger networks than the stored ones")
        return func(*args, **(kwargs or {}))


def _sizes(args: Any) -> list[int]:
    """Return the sizes in the arguments of a function that creates a tensor."""
    parts = args[0] if len(args) and isinstance(args[0], (tuple, list)) else args
    return [n for n in parts if isinstance(n, int)]
