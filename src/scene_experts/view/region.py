"""The region that photographs were taken in: pictures from outside it show what no photograph
does."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

NEAR = 0.2  # radius around each photograph's place, as a share of the distance to the scene: 11 degrees beside a photograph
SAME = 1e-3  # as a share of that distance: places nearer to each other are one, such as those of the views of a panorama
SPACING = 0.9  # quantile of the distances between neighbouring places that the radius covers at least


@dataclass(frozen=True)
class Region:
    """Balls of one radius around the places that photographs were taken from."""

    places: Tensor  # [V, 3] float64
    radius: float

    def nearest(self, place: Tensor) -> Tensor:
        """Return the point of the region that is nearest to `place` [3]."""
        away = place.to(self.places) - self.places
        distance = away.norm(dim=1)
        i = int(distance.argmin())
        if float(distance[i]) <= self.radius:
            return place
        return self.places[i] + away[i] * (self.radius / distance[i])


def find_region(places: Tensor, distance: float) -> Region:
    """Return the region of photographs taken from `places` [V, 3], at about `distance` from what
    they show."""
    places = places.double()
    radius = NEAR * distance
    if len(places) > 1:
        apart = torch.cdist(places, places)
        apart = apart.masked_fill(apart <= SAME * distance, torch.inf).amin(1)
        if len(found := apart[apart.isfinite()]):
            radius = max(radius, float(torch.quantile(found, SPACING)))
    return Region(places, radius)
