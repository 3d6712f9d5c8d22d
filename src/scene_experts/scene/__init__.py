"""Scenes: what a camera can look at, and what a training changes. The interface that the loop, evaluation and export see."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from scene_experts.core.table import Table
from scene_experts.core.types import Camera, Decoded, Points, Routing

Cull = Callable[[Tensor, Tensor, Camera], Tensor]
"""The rasteriser's visibility test: means [n, 3], scales [n, 3], camera -> [n] bool."""


class Scene(Protocol):
    """Rows of a table that decode into Gaussians for a camera."""

    table: Table
    extent: float  # the capture's R, trained world units

    @property
    def K(self) -> int:
        """Gaussians per row."""
        ...

    @property
    def file_values(self) -> int:
        """float32 values that a row takes in the file of the scene's family."""
        ...

    def __call__(self, camera: Camera, step: int, training: bool, cull: Cull) -> Decoded: ...

    def routing(self, step: int, most: int | None = None) -> dict[str, Routing]:
        """Routing of every row (of at most `most`, evenly spread), by attribute; empty without experts."""
        ...

    def scene_opacity(self, camera: Camera, step: int) -> Tensor | None:
        """Raw opacities [N, K] of every row from `camera`, seen or not; None where opacity is no network's output."""
        ...

    def rate_groups(self) -> dict[str, list[nn.Parameter]]:
        """Every parameter, by the name of its learning rate."""
        ...

    def network_tensors(self) -> dict[str, Tensor]:
        """Every learned tensor that is not a column of the table, by name."""
        ...

    def meta(self) -> dict[str, Any]:
        """The plain values that a checkpoint must keep to build the scene again (`voxel`, `extent`, ...)."""
        ...

    def eval(self) -> Any: ...

    def to(self, device: Any = None, dtype: torch.dtype | None = None) -> Any: ...


class SceneConfig(Protocol):
    """What a scene is made of: a frozen dataclass, whose fields are the recipe's flags under --scene."""

    def start(self, points: Points, extent: float, cameras: Sequence[Camera] = ()) -> Scene:
        """A new scene from a point cloud and the training views' cameras; scenes that need no cameras do without."""
        ...

    def load(self, table: Table, meta: dict[str, Any]) -> Scene:
        """The scene that a checkpoint's table and `Scene.meta()` describe; its networks' tensors are filled in by the caller."""
        ...

    def scaled(self, factor: float) -> Any:
        """The same with every window of its schedule `factor` times as long."""
        ...

    def check(self) -> None:
        """Raises InputError, naming the flag, for settings that no training can have."""
        ...
