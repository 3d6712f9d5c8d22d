"""Options of `scene-experts reproduce`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from scene_experts.arguments.option import Option
from scene_experts.core.errors import expect_at_least


@dataclass(frozen=True)
class ReproduceOptions:
    """Reproduce the paper's tables and figures.

    Missing runs are trained, interrupted runs are continued and finished runs are reused.
    """

    experiments: Annotated[tuple[str, ...], Option(value="EXPERIMENT")]
    """table1, table2, table3, table4, fig1b, fig3, fig5, fig6, fig7, appendix, all of these (all), extras (recipes that the paper does not
    have), or compare (the recipes of --recipes)."""
    captures: Annotated[tuple[Path, ...], Option(value="CAPTURE")] = ()
    """Your own captures instead of the paper's scenes."""
    data: Path | None = None
    """Folder with the paper's scenes; by default where `scene-experts download` puts them."""
    scenes: Annotated[tuple[str, ...], Option(value="SCENE")] = ()
    """Use only these scenes."""
    out: Path = Path("reproduce")
    """Folder for tables, figures and records of runs."""
    runs: Path | None = None
    """Folder for run folders; by default OUT/runs."""
    records: Path | None = None
    """Folder for records of finished runs; by default OUT/records. Reproductions at different scales can share it."""
    scale: float = 1.0
    """1 is the size of the paper. Smaller values shorten the schedule and reduce the resolution."""
    iterations: int | None = None
    """Number of training iterations, instead of what --scale gives."""
    resolution: Annotated[str | None, Option(value="POLICY")] = None
    """Resolution policy (as-is, longest:PX and others), instead of what --scale gives."""
    seeds: tuple[int, ...] = (0,)
    """Seeds; each experiment is run once for each."""
    workers: int | None = None
    """Number of runs at a time, each in its own process; by default one, or one for each of --devices."""
    devices: Annotated[tuple[str, ...], Option(value="INDEX")] = ()
    """Indices of the CUDA devices that the workers share."""
    recipes: Annotated[tuple[str, ...], Option(value="RECIPE")] = ()
    """Run only the rows of these recipes. With compare: the recipes to compare, any recipe of `scene-experts train`, also with flags and a
    name: "moe-gs" "narrow=moe-gs --scene.hidden 16"."""
    baseline: Annotated[tuple[str, ...], Option(value="RECIPE")] = ()
    """With compare: show the differences from these recipes (or names of --recipes); by default from the first of --recipes."""
    discard: bool = False
    """Delete each run folder when its record is written."""
    adopt: Annotated[tuple[Path, ...], Option(value="RUN")] = ()
    """Existing run folders to use if they match a run exactly."""
    dry_run: bool = False
    """List the runs and train nothing."""
    tables_only: bool = False
    """Write the tables and figures of the finished runs and train nothing."""

    @property
    def worker_count(self) -> int:
        """Number of runs at a time."""
        return self.workers if self.workers is not None else max(1, len(self.devices))

    def check(self) -> None:
        """Raises InputError, naming the option, for invalid values."""
        expect_at_least([("--workers", self.worker_count, 1), *(("--seeds", seed, 0) for seed in self.seeds)])
