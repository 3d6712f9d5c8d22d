"""Options of `scene-experts reproduce`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from scene_experts.arguments.option import Option
from scene_experts.core.errors import InputError
from scene_experts.core.fields import Flag, Range


@dataclass(frozen=True)
class ReproduceOptions:
    """Reproduce the paper's tables and figures.

    Missing runs are trained, interrupted runs are continued and finished runs are reused.
    """

    experiments: Annotated[tuple[str, ...], Option(value="EXPERIMENT")]
    """table1, table2, table3, table4, fig1b, fig3, fig5, fig6, fig7, appendix, all of these (all),
    extras (recipes that the paper does not have), or compare (the recipes of --recipes)."""
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
    """Folder for records of finished runs; by default OUT/records. Reproductions at different
    scales can share it."""
    scale: float = 1.0
    """1 is the size of the paper. Smaller values shorten the schedule and reduce the resolution."""
    iterations: int | None = None
    """Number of training iterations, instead of what --scale gives."""
    resolution: Annotated[str | None, Option(value="POLICY")] = None
    """Resolution policy (as-is, longest:PX and others), instead of what --scale gives."""
    seeds: Annotated[tuple[int, ...], Range(0)] = (0,)
    """Seeds; each experiment is run once for each."""
    folds: Annotated[int | None, Range(2)] = None
    """Train this many times for each run, so that every photograph is held out once, and score them
    all. For captures of fewer than 40 photographs."""
    workers: Annotated[int | None, Range(1)] = None
    """Number of runs at a time, each in its own process; by default one, or one for each of
    --devices."""
    devices: Annotated[tuple[str, ...], Option(value="INDEX")] = ()
    """Indices of the CUDA devices that the workers share."""
    cluster: Annotated[str | None, Option(value="ADDRESS")] = None
    """Train the runs on the workers of the Dask scheduler at this address, e.g. tcp://HOST:8786
    (needs `pip install distributed`). All machines must share the folders."""
    resources: Annotated[tuple[str, ...], Option(value="NAME=AMOUNT")] = ()
    """With --cluster: what a run takes from its worker, e.g. GPU=1; by default one thread. Start
    the workers with `dask worker --resources "GPU=1"`."""
    recipes: Annotated[tuple[str, ...], Option(value="RECIPE")] = ()
    """Run only the rows of these recipes. With compare: the recipes to compare, any recipe of
    `scene-experts train`, also with flags and a name: "moe-gs" "narrow=moe-gs --scene.hidden
    16"."""
    baseline: Annotated[tuple[str, ...], Option(value="RECIPE")] = ()
    """With compare: show the differences from these recipes (or names of --recipes); by default
    from the first of --recipes."""
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

    def needs(self) -> dict[str, float]:
        """Return --resources as amounts by name. Raises InputError if one is not NAME=AMOUNT with a
        positive amount."""
        found = {}
        for text in self.resources:
            name, _, amount = text.partition("=")
            try:
                found[name] = float(amount)
            except ValueError:
                found[name] = 0.0
            if not name or not 0 < found[name] < math.inf:
                raise InputError(f"expected --resources as NAME=AMOUNT with an amount above 0, found '{text}'; give for example GPU=1")
        return found

    def check(self, flag: Flag) -> None:
        if self.cluster is not None and (self.workers is not None or self.devices):
            other = flag("devices" if self.devices else "workers")
            raise InputError(f"expected either --cluster or {other}, found both; the cluster's own workers set their number and devices")
        if self.resources and self.cluster is None:
            raise InputError("expected --resources together with --cluster, found no --cluster; add it or leave --resources out")
        self.needs()
