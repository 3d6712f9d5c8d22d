"""Names of devices and rasterisers, as commands and the Python API take them."""

from typing import Literal

Device = Literal["auto", "cpu", "cuda"]
Raster = Literal["auto", "reference", "cpu", "gsplat"]
