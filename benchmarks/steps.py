"""Training steps one by one: the loop is that of the command, and a caller is told where each step begins and ends."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from scene_experts.data.capture import Capture
from scene_experts.data.settings import Data
from scene_experts.render import choose
from scene_experts.training import loop
from scene_experts.training.config import RunConfig
from scene_experts.training.events import Stepped
from scene_experts.training.options import TrainOptions
from scene_experts.training.recipes import RECIPES

BLOCK = 40  # steps of a turn; densification runs every 100


def run_blocks(
    recipe: str, data: Path, capture: Capture, begin: int, before: Callable[[], None], after: Callable[[], None], device: str = "cuda"
) -> Iterator[None]:
    """Train a recipe of 30,000 iterations in blocks of BLOCK steps around iteration `begin`, without densification.

    The scene is that of the beginning; `begin` says which losses and which phase of the experts apply. `before` and `after` are called
    around every step of a block but its last one.
    """
    counting = False

    def start(training: Any) -> None:
        training.step = begin

    def watch(training: Any) -> None:
        nonlocal counting
        if counting:
            after()
        counting = True
        if training.step >= begin + 2 * BLOCK:
            training.step = begin
        before()

    cfg = replace(RECIPES[recipe][1], iterations=30_000)
    options = TrainOptions(preview_every=0, log_every=BLOCK, save_every=10**9)
    job = loop.Job(RunConfig(cfg, Data(data)), device=device, options=options, begin=start, watch=watch)
    for event in loop.train(cfg, job, capture, choose("auto", device)):
        if isinstance(event, Stepped):
            counting = False  # the statistics of the log and the pause are not part of a step
            yield
