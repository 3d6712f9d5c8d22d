"""Folds: every photograph of a capture is held out once, and all of them are scored.

A capture of 15 photographs holds out two, and their mean says little. With K folds, each run becomes
K trainings; training k holds out every Kth view, beginning with the kth. Their records together are
one record of the capture, with the scores of all views.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from statistics import fmean
from typing import Any

from scene_experts.core.errors import InputError
from scene_experts.data import capture as captures
from scene_experts.data.settings import Data
from scene_experts.reproduce.plan import CaptureSpec
from scene_experts.reproduce.store import MEANS, Record


def split_of(fold: int, folds: int) -> str:
    """Return the value of --split that holds out one fold, 1 to `folds`."""
    return f"fold:{fold}/{folds}"


def hold_out_each(scenes: Sequence[CaptureSpec], folds: int) -> list[CaptureSpec]:
    """Return each capture once for each fold."""
    splits = [split_of(fold, folds) for fold in range(1, folds + 1)]
    return [replace(scene, options={**scene.options, "split": split}) for scene in scenes for split in splits]


def check_folds(scenes: Sequence[CaptureSpec], folds: int) -> None:
    """Raise InputError for a capture with fewer photographs than folds, of which one would hold
    none out."""
    for scene in scenes:
        try:
            capture = captures.load(Data(scene.path), allow_no_points=True)
        except InputError:
            continue  # the runs say what is wrong
        capture.images.close()
        if (few := len(capture.views)) < folds:
            raise InputError(
                f"expected captures of at least {folds} photographs for --folds {folds}, found {few} in {scene.path}; give fewer"
            )


def join(records: Sequence[Record], folds: int) -> list[Record]:
    """Return one record for the records of all folds of a training, with the scores of all views
    and the means of other results. Trainings without one of their folds are left out."""
    wanted = [split_of(fold, folds) for fold in range(1, folds + 1)]
    return [_join([by_split[split] for split in wanted]) for by_split in _by_training(records).values() if by_split.keys() >= {*wanted}]


def find_incomplete(records: Sequence[Record], folds: int) -> list[str]:
    """Return one line for each training that `join` leaves out: what it is, and its missing
    folds."""
    lines = []
    for (scene, recipe, seed), by_split in _by_training(records).items():
        missing = [str(fold) for fold in range(1, folds + 1) if split_of(fold, folds) not in by_split]
        if missing:
            which = f"{len(missing)} of {folds} folds are missing ({', '.join(missing)})"
            lines.append(f"{recipe} on {scene}, seed {seed}, is not in the tables: {which}")
    return lines


def _by_training(records: Sequence[Record]) -> dict[tuple[str, str, int], dict[str, Record]]:
    """Return the records of each training by split."""
    found: dict[tuple[str, str, int], dict[str, Record]] = {}
    for record in records:
        found.setdefault((record.scene, record.recipe, record.seed), {})[record.config.data.split] = record
    return found


def _join(parts: Sequence[Record]) -> Record:
    per_view = {name: scores for part in parts for name, scores in part.per_view.items()}
    results = _average([{**part.results, **_ranked(part.results)} for part in parts]) | {"view_count": len(per_view)}
    scored = [view for view in per_view.values() if "psnr" in view]  # others are masked wholly
    for metric in MEANS:
        scores = [view[metric] for view in scored if metric in view]
        results[metric] = fmean(scores) if scores and len(scores) == len(scored) else None
    fits = [part.fit for part in parts if part.fit is not None]
    return replace(parts[0], results=results, per_view=per_view, fit=fmean(fits) if len(fits) == len(parts) else None)


def _ranked(results: dict[str, Any]) -> dict[str, Any]:
    """Return the shares of the experts of a training, of each attribute from the busiest to the least
    busy: in another fold, the expert of a number is another one."""
    found = {}
    for attribute, shares in (results.get("experts") or {}).items():
        by = shares.get("share") or shares.get("mean_gate") or []
        order = sorted(range(len(by)), key=lambda expert: -by[expert])
        found[attribute] = {
            name: [value[expert] for expert in order] if isinstance(value, list) and len(value) == len(order) else value
            for name, value in shares.items()
        }
    return {"experts": found} if found else {}


def _average(values: Sequence[Any]) -> Any:
    """Return the mean of JSON values: of each number that all have, and what is equal in all. Else
    None."""
    first = values[0]
    if all(isinstance(value, dict) for value in values):
        return {name: _average([value[name] for value in values]) for name in first if all(name in value for value in values)}
    if all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in values):
        return fmean(values)
    if all(isinstance(value, list) and len(value) == len(first) for value in values):
        return [_average(each) for each in zip(*values)]
    return first if all(value == first for value in values) else None
