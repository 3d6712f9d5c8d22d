"""What `scene-experts eval RUN` does: open the run, load its capture, evaluate."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console

from scene_experts.core.group import Alone
from scene_experts.evaluate.options import EvalOptions
from scene_experts.evaluate.photographs import score_training_views
from scene_experts.evaluate.results import About
from scene_experts.evaluate.score import evaluate
from scene_experts.render import Rasterizer, as_trained
from scene_experts.training import run_folder
from scene_experts.training.progress import ProgressBar
from scene_experts.training.run_folder import OpenRun

log: logging.Logger = logging.getLogger(__name__)


def evaluate_run(
    run: Path,
    device: str,
    rasterize: Rasterizer,
    options: EvalOptions,
    *,
    data: Path | None = None,
    step: int | None = None,
    group: Alone | None = None,
) -> dict[str, Any]:
    """Evaluate the newest checkpoint of a run folder, or the one at `step`. data: the folder of the
    capture, if it has moved.

    group: The processes that share the views, as in `evaluate`.

    The rasteriser antialiases as the run's recipe does, if it can. Raises InputError if run,
    checkpoint, capture and options do not fit.
    """
    group = group or Alone()
    opened = group.agree(lambda: run_folder.open_run(run, device, step))
    rasterize = as_trained(rasterize, opened.config.train.antialias)
    capture = group.agree(lambda: run_folder.capture_of(opened, data))
    if options.views == "test" and options.appearance == "rule" and not capture.test and capture.train:
        options = replace(options, views="train")
        if group.first:
            log.warning(
                "no view is held out: these are scores of the %d training views, which other views do not reach", len(capture.train)
            )
    facts: dict[str, Any] = {"step": opened.step, "about": about(opened), "group": group}
    try:
        with ProgressBar(Console(stderr=True, markup=False, quiet=not group.first)) as tell:
            found = evaluate(opened.scene, capture, rasterize, run, options, **facts, progress=tell)
            if not options.suffix:  # the report lists all photographs
                score_training_views(opened.scene, capture, rasterize, run, opened.step, tell, group)
            return found
    finally:
        capture.images.close()


def about(run: OpenRun) -> About:
    """What the results file says of the training of an opened run."""
    return About(
        recipe=run.config.train.recipe,
        iterations=run.config.train.iterations if run.step else 0,  # an imported file that says nothing of its training
        seed=run.config.train.seed,
        train_seconds=run.clock.seconds,
        cpu_seconds=run.clock.cpu_seconds,
        load=run.clock.load,
        versions=run.config.versions,
    )
