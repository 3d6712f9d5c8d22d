"""How a recipe is trained: the options that `scene-experts train`, the Python API and the training
loop share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from scene_experts.arguments.option import Option
from scene_experts.core.choices import Device, Raster
from scene_experts.core.fields import Count, CountOrNone, NotNegative, Range


@dataclass(frozen=True)
class TrainOptions:
    """How a recipe is trained. Results depend on `stop_at` and `max_memory`; their rounding on
    `deterministic`, `device` and `rasterizer`."""

    overwrite: bool = False
    """Replace the run in the folder: its checkpoints and results are deleted."""
    resume: bool = False
    """Continue from the newest intact checkpoint of the run."""
    stop_at: Annotated[int | None, Range(1)] = None
    """Stop at this iteration and leave the schedule as it is; --iterations rescales the
    schedule."""
    deterministic: bool = False
    """Give bit-identical results on the same machine, also after --resume. Slightly slower."""
    device: Device = "auto"
    """Device to train on. auto: CUDA if available."""
    rasterizer: Raster = "auto"
    """Rasteriser. auto: the fastest that works on the device."""
    save_every: Count = 5000
    """Iterations between checkpoints, of which the newest `keep_checkpoints` are kept."""
    keep_checkpoints: CountOrNone = 2
    """Number of checkpoints in RUN/checkpoints; older ones are removed. 0 keeps all, for `eval
    --step`."""
    preview_every: CountOrNone = 1000
    """Iterations between previews of a held-out view in RUN/previews; 0 means none."""
    log_every: Annotated[Count, Option(hidden=True)] = 10
    """Iterations between `Stepped` events."""
    max_memory: NotNegative = 0.0
    """Stop densification at this memory of the process in GiB, resident or reserved on the GPU; 0
    means no limit."""
    tensorboard: bool = False
    """Also write RUN/tensorboard (needs `pip install tensorboard`)."""
