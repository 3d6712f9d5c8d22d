"""What a training tells its listeners: the terminal, the run folder, a viewer."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from torch import Tensor

from scene_experts.strategy import Edit


@dataclass(frozen=True)
class Started:
    step: int  # 0, or where the run resumes
    total: int  # the last iteration of this run
    anchors: int
    voxel: float = 0.0  # edge of the finest lattice cell, trained world units; 0: explicit Gaussians on no lattice


@dataclass(frozen=True)
class Stepped:
    step: int
    terms: dict[str, float]  # weighted, by name
    psnr: float  # of the training view where its mask counts, dB
    anchors: int
    visible: int  # anchors this view decoded
    gaussians: int  # handed to the rasteriser: of these anchors, with positive opacity
    active: float  # share of decoded Gaussians with positive opacity
    seconds: float  # of training so far, without saving and previews
    routing: dict[str, list[float]]  # share of this view's assignments per expert, by attribute; of its gates while dense
    balance: dict[str, float] = field(default_factory=dict)  # L_load^S / k, or L_load^D while dense, by attribute: 1 is perfect balance
    entropy: dict[str, float] = field(default_factory=dict)  # of the gates, by attribute: 1 all experts alike, 0 one alone
    scene_routing: dict[str, list[float]] = field(default_factory=dict)  # as routing, of anchors all over the scene
    scene_gates: dict[str, list[float]] = field(default_factory=dict)  # their mean gate per expert


@dataclass(frozen=True)
class Adjusted:
    step: int
    edit: Edit


@dataclass(frozen=True)
class Previewed:
    step: int
    view: int
    picture: Tensor  # [H, W, 3]


@dataclass(frozen=True)
class Saved:
    step: int
    path: Path


@dataclass(frozen=True)
class Stopped:
    step: int
    reason: str


@dataclass(frozen=True)
class Exported:
    """The scene was written to the run folder in the layout that other tools read."""

    step: int
    path: Path  # RUN/point_cloud/iteration_N
    warnings: tuple[str, ...] = ()  # what other readers of the layout get wrong


@dataclass(frozen=True)
class Finished:
    step: int
    seconds: float


Event = Started | Stepped | Adjusted | Previewed | Saved | Stopped | Exported | Finished
