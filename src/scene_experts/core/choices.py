"""Names of devices and rasterisers that the commands and the Python API accept."""

from typing import Literal

Device = Literal["auto", "cpu", "cuda"]
Raster = Literal["auto", "reference", "cpu", "gsplat"]
