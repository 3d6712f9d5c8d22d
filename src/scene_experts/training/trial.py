"""Measure the memory of a training on a few views before it begins."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from scene_experts.data.capture import Capture
from scene_experts.scene import Scene
from scene_experts.training.memory import check_start, give_back, used_bytes
from scene_experts.training.state import Training

VIEWS = 3
IMAGES = 0.25  # share of the memory that is left at the start, for decoded photographs


def fit_memory(training: Training, max_memory: float, capture: Capture, see: Callable[[int, int, Tensor | None], object]) -> None:
    """Limit the cache of the photographs, and check that a training fits into memory before it
    begins.

    The views are drawn as the first and as the last iteration draw them. The training is then as it
    was before.

    Args:
        training: The training, at its start or restored.
        max_memory: Limit on the memory of the process, GiB.
        capture: The capture that it is trained on.
        see: Draws a view and adds the gradients of its loss: number of the iteration, index of the
            view, background [3] or None.

    Raises:
        InputError: The training does not fit.
    """
    scene, device, largest = training.scene, training.scene.table.device, training.largest
    begun, images = training.step > 0, 0
    table = sum(v.element_size() * v.numel() * (3 if begun and v.requires_grad else 1) for v in scene.table.columns().values())
    give_back()
    largest.level = max(0, used_bytes(device) - table)
    check_start(scene, begun, max_memory, largest)
    if device.type != "cuda":
        capture.images.limit(int(IMAGES * (max_memory * 2**30 - used_bytes(device))))
        images = max(0, min(capture.images.cache_bytes, capture.images.count_bytes(capture.train)) - capture.images.used_bytes)
    color = torch.zeros(3) if training.cfg.random_background else None
    with unchanged(scene):
        for number in (0, training.cfg.iterations + 1):  # no iteration has these numbers
            for index in capture.train[:: max(1, len(capture.train) // VIEWS)][:VIEWS]:
                see(number, index, color)
                training.optimizer.zero_grad(set_to_none=True)
    give_back()
    check_start(scene, begun, max_memory, largest, images)


@contextmanager
def unchanged(scene: Scene) -> Iterator[None]:
    """Context manager after which the random number generators and the tensors of a scene's
    networks are as they were before."""
    columns = {id(v) for v in scene.table.params.values()}
    networks = [*(p for p in scene.parameters() if id(p) not in columns), *scene.buffers()]
    before = [t.detach().clone() for t in networks]
    device = scene.table.device
    with torch.random.fork_rng([device] if device.type == "cuda" else []):
        yield
    with torch.no_grad():
        for tensor, value in zip(networks, before, strict=True):
            tensor.copy_(value)
