"""What the page shows of a run: its configuration, its scores and its training."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from scene_experts.core.errors import InputError
from scene_experts.core.io import read_json
from scene_experts.core.reading.budget import RUN
from scene_experts.core.reading.plain import read_json_lines
from scene_experts.core.reading.source import guarding, inside
from scene_experts.data.views import same_poses
from scene_experts.evaluate.photographs import Photograph, read_photographs
from scene_experts.evaluate.results import command_of, load_results, results_file
from scene_experts.evaluate.tables import distinguish_runs
from scene_experts.training import run_folder
from scene_experts.training.config import RunConfig


@dataclass(frozen=True)
class ShownRun:
    """What the page shows of one run. `metrics`: lines of metrics.jsonl; `per_view`: scores by the
    name of a view."""

    name: str
    path: Path
    config: RunConfig
    results: dict[str, Any]
    per_view: dict[str, dict[str, Any]]
    metrics: list[dict[str, Any]]
    photographs: list[Photograph]
    views: str = "test"  # those that are shown: "train" for a run that holds none out

    @property
    def pictures(self) -> Path:
        """The folder of the pictures of the shown views."""
        return self.path / self.views


def read_run(run: Path) -> ShownRun:
    """Read a run folder: the scores of its held-out views, or of its training views if only these
    were scored. Raises InputError if it is not evaluated or its scores by view are invalid."""
    config, results = run_folder.read_config(run), load_results(run, training=True)
    views = "train" if results_file(run).name == "results_train.json" else "test"
    path = run / ("per_view.json" if views == "test" else "per_view_train.json")
    per_view = read_json(path, "scores by view") if path.is_file() else {}
    if not isinstance(per_view, dict) or not all(isinstance(v, dict) and isinstance(v.get("file"), str) for v in per_view.values()):
        raise InputError(f"expected scores by view in {path}, found something else; run `{command_of(run)}` again")
    with guarding(path, RUN, "file of scores by view"):
        for facts in per_view.values():
            inside(run / views / "gt", facts["file"])
    metrics = read_metrics(run / "metrics.jsonl")
    return ShownRun(config.train.recipe, run, config, results, per_view, metrics, read_photographs(run), views)


def tell_apart(sources: list[ShownRun]) -> list[ShownRun]:
    """Give runs of the same recipe different names."""
    names = distinguish_runs([s.path for s in sources], [s.name for s in sources])
    return [replace(s, name=name) for s, name in zip(sources, names)]


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """Read the complete lines of a metrics file."""
    return [line for line in read_json_lines(path) if isinstance(line.get("step"), (int, float))] if path.is_file() else []


def group_by_capture(sources: Sequence[ShownRun]) -> dict[str, list[ShownRun]]:
    """Group runs by the name and the camera poses of their capture: only these can have views in
    common.

    The keys are the names, with a number where captures of one name have other poses.
    """
    groups: dict[str, list[ShownRun]] = {}
    for s in sources:
        name, number = str(s.results.get("capture", "?")), 1
        key = name
        while key in groups and not same_poses(groups[key][0].results.get("poses"), s.results.get("poses")):
            number += 1
            key = f"{name} ({number})"
        groups.setdefault(key, []).append(s)
    return groups


def find_common_views(sources: Sequence[ShownRun]) -> list[str]:
    """Return the names of the views that every run was scored on."""
    return [name for name in sources[0].per_view if all(name in s.per_view for s in sources)]
