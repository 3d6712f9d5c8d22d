"""What a training is asked to do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import torch

from scene_experts.core.group import Alone
from scene_experts.training.config import RunConfig, Train
from scene_experts.training.options import TrainOptions
from scene_experts.training.state import Training


@dataclass(frozen=True)
class Job:
    """A training to be done: what is trained, where and how. `config` has the settings that results
    depend on."""

    config: RunConfig  # with `stop_at`, `max_memory` and `init_from`
    out: Path | None = None  # the run folder; None writes no files
    device: str = "cpu"
    dtype: torch.dtype = torch.float32  # float64 is for tests of rounding errors with the reference rasteriser
    options: TrainOptions = TrainOptions(preview_every=0)
    begin: Callable[[Training], None] = lambda training: None  # called once, before the first event
    watch: Callable[[Training], None] = lambda training: None  # called between iterations and not timed; the viewer renders here
    shard: bool = False  # divide the rows of the table among the processes
    group: Alone = field(default_factory=Alone)  # the processes that share the views of each batch; process 0 writes all files
    stop: list[str] = field(default_factory=list)  # append a reason to save and stop, for example from a signal handler

    @property
    def max_memory(self) -> float:
        """GiB of memory at which densification stops; 0: no limit."""
        return self.config.max_memory


def last_iteration(cfg: Train, run: Job) -> int:
    """Return the iteration at which a training ends: `stop_at` at the end of its batch, or all
    iterations."""
    return min(cfg.iterations, -(-(run.config.stop_at or cfg.iterations) // cfg.batch) * cfg.batch)
