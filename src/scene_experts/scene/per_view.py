"""What a training learns of each of its photographs beside the scene: one row for each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Self

import torch
from torch import Tensor, nn

from scene_experts.core.types import Camera


class PerView(nn.Module):
    """A learned row for each training photograph, found by the id of its camera."""

    group: ClassVar[str]
    """Name of the learning rate, and of the tensors in a checkpoint."""
    learned: ClassVar[str]
    """Name of the parameter [V, ...]."""
    buffers_kept: ClassVar[tuple[str, ...]]
    """Names of the buffers, with `ids`."""
    ids: Tensor  # [V] int64
    row: dict[int, int]

    def set_cameras(self, cameras: Sequence[Camera]) -> None:
        """Say whose rows these are."""
        self.register_buffer("ids", torch.tensor([camera.id for camera in cameras]))
        self.row = {camera.id: i for i, camera in enumerate(cameras)}

    @classmethod
    def restore(cls, tensors: Mapping[str, Tensor]) -> Self | None:
        """Return the rows of a checkpoint's tensors; None if it has none."""
        if f"{cls.group}.{cls.learned}" not in tensors:
            return None
        made = cls.__new__(cls)
        nn.Module.__init__(made)
        setattr(made, cls.learned, nn.Parameter(tensors[f"{cls.group}.{cls.learned}"].clone()))
        for name in cls.buffers_kept:
            made.register_buffer(name, tensors[f"{cls.group}.{name}"].clone())
        made.row = {int(id): i for i, id in enumerate(made.ids.tolist())}
        return made

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors by their names in a checkpoint."""
        return {f"{self.group}.{name}": value.detach() for name, value in self.state_dict().items()}
