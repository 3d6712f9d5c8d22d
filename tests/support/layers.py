"""Scenes in layers, for tests: a coarse scene that nobody fitted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from scene_experts.core.reading import budget
from scene_experts.core.reading.source import opening
from scene_experts.files.anchors import compact
from scene_experts.files.anchors.data import AnchorData
from scene_experts.files.anchors.layers import EncodedLayers, LayeredScene, encode


def make_coarse(data: AnchorData, share: float = 0.4, seed: int = 0) -> tuple[torch.Tensor, AnchorData]:
    """The rows of a coarse scene and that scene: a share of the anchors and of their slots, moved a little."""
    g = torch.Generator().manual_seed(seed)
    n, K = len(data.columns["feature"]), data.columns["offsets"].shape[1]
    rows = (torch.rand(n, generator=g) < share).nonzero().squeeze(1)
    columns = {name: value[rows] for name, value in data.columns.items()}
    slots = torch.rand(len(rows), K, generator=g) < 0.6
    columns["slots"] = slots & columns["slots"] if "slots" in columns else slots
    for name in ("feature", "log_scaling", "offsets"):
        columns[name] = columns[name] + 0.01 * torch.randn(columns[name].shape, generator=g)
    p = data.precision
    assert p is not None and data.cells is not None
    precision = replace(p, steps={name: value * 16 for name, value in p.steps.items()}, classes=p.classes[rows])
    return rows, replace(data, columns=columns, cells=data.cells[rows], precision=precision)


def make_layers(data: AnchorData, share: float = 0.4) -> EncodedLayers:
    """The layers of a scene whose last anchors are seen first."""
    rows, coarse = make_coarse(data, share)
    return encode(data, rows, coarse, torch.arange(len(data.columns["feature"])).float())


def open_layers(folder: Path, layers: EncodedLayers, plan: bytes | None = None) -> LayeredScene:
    """The scene of layers, of which no chunk is taken."""
    path = folder / "coarse.compact"
    path.write_bytes(layers.coarse)
    with opening(path, budget.COMPACT) as source:
        return LayeredScene(compact.decode_whole(source.read(), source), layers.plan if plan is None else plan, source)
