"""An average of the weights along the training, which is evaluated and exported in place of the
last weights.

The average of n updates is a_n = a_(n-1) + w_n (p_n - a_(n-1)) with w_n = max(1 / n, interval /
(span T)): the mean of all weights so far at first, then an exponential average over the last `span`
of the T iterations. It is a function of the step alone, so a resumed run continues it. New rows of
a table start with their own values (`Table.append`); removed rows leave (`Table.keep`). Source:
Polyak and Juditsky 1992; Izmailov et al. 2018, "Averaging weights leads to wider optima and better
generalization".
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor

from scene_experts.core.fields import Count, Share, With
from scene_experts.core.parts import Part, register
from scene_experts.scene import Scene


@register
@dataclass(frozen=True)
class Average(Part):
    """Which average of the weights is evaluated and exported; flags under --average."""

    span: Share = 0.0
    """Share of the training that the average spans (0.05 to 0.2 are useful); 0 uses the last
    weights."""
    interval: Annotated[Count, With(("span",))] = 10
    """Iterations between two updates of the average."""

    def due(self, step: int) -> bool:
        """Whether the average is updated after iteration `step`. Before the first interval ends,
        the average is the last weights."""
        return self.span > 0 and (step < self.interval or step % self.interval == 0)

    def weight(self, step: int, total: int) -> float:
        """Return the weight of the new values in the update after iteration `step` of `total`, in
        (0, 1]."""
        return min(1.0, max(self.interval / step, self.interval / (self.span * total)))


class Averages:
    """The averages of a scene's weights: columns in the scene's table, which keeps their rows
    aligned, and networks here."""

    networks: dict[str, Tensor]

    def __init__(self, scene: Scene) -> None:
        """Start the averages with the present weights."""
        self.scene = scene
        scene.table.averages = {name: p.detach().clone() for name, p in scene.table.params.items()}
        self.networks = {name: p.detach().clone() for name, p in scene.network_tensors().items()}

    @torch.no_grad()
    def update(self, weight: float) -> None:
        """Move every average towards the present weights: a + weight (p - a)."""
        for averages, parameters in self._pairs():
            for name, average in averages.items():
                if average.is_floating_point():
                    average.lerp_(parameters[name].detach(), weight)
                else:
                    average.copy_(parameters[name])

    @contextmanager
    def swapped(self) -> Iterator[None]:
        """Context manager in which the scene has the averages as its weights. Do not train in
        it."""
        self._swap()
        try:
            yield
        finally:
            self._swap()

    def tensors(self) -> dict[str, Tensor]:
        """Return the averages by their names in checkpoints."""
        columns = {f"average.params.{name}": value for name, value in self.scene.table.averages.items()}
        return columns | {f"average.network.{name}": value for name, value in self.networks.items()}

    @torch.no_grad()
    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Copy the averages of a checkpoint. Names that it lacks keep the present weights."""
        for name, value in self.tensors().items():
            if name in tensors:
                value.copy_(tensors[name])

    def _pairs(self) -> list[tuple[dict[str, Tensor], dict[str, Tensor]]]:
        return [(self.scene.table.averages, dict(self.scene.table.params.items())), (self.networks, self.scene.network_tensors())]

    def _swap(self) -> None:
        for averages, parameters in self._pairs():
            for name, parameter in parameters.items():
                averages[name], parameter.data = parameter.data, averages[name]
