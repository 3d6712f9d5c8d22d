"""What `scene-experts eval RUN` does: open the run, load its capture, evaluate."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from rich.console import Console

from scene_experts.evaluate.score import About, evaluate
from scene_experts.render import Rasterizer, as_trained
from scene_experts.training import run_folder
from scene_experts.training.progress import Bar


def evaluate_run(
    run: Path,
    device: str,
    rasterize: Rasterizer,
    *,
    data: Path | None = None,
    views: Literal["test", "train"] = "test",
    appearance: Literal["rule", "half"] = "rule",
    step: int | None = None,
    lpips: bool = True,
    lpips_weights: Path | None = None,
    download: bool = False,
) -> dict[str, Any]:
    """Evaluate the newest checkpoint of a run folder (or the one at `step`) on its capture, which `data` may say has moved.

    The rasteriser's antialiasing follows the run's recipe where it can. Raises InputError for anything that does not fit.
    """
    opened = run_folder.open_run(run, device, step)
    rasterize = as_trained(rasterize, opened.cfg.antialias)
    capture = run_folder.capture_of(opened, data)
    about = About(
        recipe=opened.config.train.recipe,
        iterations=opened.cfg.iterations if opened.step else 0,  # an imported file that says nothing of its training
        seed=opened.cfg.seed,
        train_seconds=opened.clock.seconds,
        cpu_seconds=opened.clock.cpu_seconds,
        load=opened.clock.load,
        versions=opened.config.versions,
    )
    try:
        with Bar(Console(stderr=True)) as tell:
            return evaluate(
                opened.scene,
                capture,
                rasterize,
                run,
                step=opened.step,
                views=views,
                appearance=appearance,
                lpips=lpips,
                lpips_weights=lpips_weights,
                download=download,
                about=about,
                progress=tell,
            )
    finally:
        capture.images.close()
