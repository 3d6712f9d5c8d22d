"""Records of finished runs: one JSON file a run with its configuration, results, scores by view and training curves.

A record holds everything that the tables and figures need. It takes about 20 kB, so it can be committed where checkpoints cannot.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from statistics import fmean
from typing import Any

from scene_experts.core.errors import InputError, few
from scene_experts.core.io import read_json, write_bytes
from scene_experts.core.plain import from_json, to_json
from scene_experts.core.reading.budget import JSON, RUN, Damaged
from scene_experts.core.reading.plain import read_json_lines
from scene_experts.core.reading.source import guarding
from scene_experts.data.views import same_poses
from scene_experts.evaluate.results import load_results
from scene_experts.reproduce.columns import columns, length, rows, text
from scene_experts.reproduce.plan import Spec, identity
from scene_experts.training.config import RunConfig
from scene_experts.training.run_folder import load_capture, read_config

FORMAT = 2  # format 1 has a row for each view and each point of a curve
POINTS = 60  # the most samples of a training curve
CURVES = ("step", "seconds", "psnr", "anchors", "active", "routing", "entropy", "scene_routing", "scene_gates")
MEANS = ("psnr", "ssim", "lpips", "lpips_3dgs")
PER_VIEW = (*MEANS, "activation_ratio", "gaussians_rendered")


@dataclass(frozen=True)
class Record:
    """One finished run.

    `results` is its results.json. `per_view` maps the name of a held-out view to its scores (PER_VIEW). `curves` holds the values of
    CURVES at up to POINTS iterations. `code` is a hash of the code of other packages that it was trained with (`plan.code_of`).
    """

    scene: str
    config: RunConfig
    results: dict[str, Any]
    per_view: dict[str, dict[str, Any]]
    curves: list[dict[str, Any]]
    code: str = ""

    @cached_property
    def key(self) -> str:
        """As `Spec.key`; of a run that started from another one, a key that no `Spec` has."""
        return identity(self.scene, self.config.train, self.config.data, self.code, self.config.init_from)

    @cached_property
    def numbers(self) -> str:
        """As `Spec.numbers`."""
        return identity(self.scene, replace(self.config.train, recipe=""), self.config.data, self.code, self.config.init_from)

    @property
    def recipe(self) -> str:
        return self.config.train.recipe

    @property
    def seed(self) -> int:
        return self.config.train.seed

    def value(self, column: str) -> float | None:
        """Return the value of a table's column, e.g. psnr (dB), size_mb (10^6 bytes), active_percent, train_seconds; None if unknown."""
        if column == "size_mb":
            return self.results["size"]["MB"]
        if column == "active_percent":
            share = self.results.get("activation_ratio")
            return None if share is None else 100 * share
        return self.results.get(column)


def read_run(run: Path, scene: str, code: str = "") -> Record:
    """Make the record of an evaluated run folder. Raises InputError where files are missing or the training was scored before its end."""
    for name in ("config.json", "results.json", "per_view.json"):
        if not (run / name).is_file():
            raise InputError(f"expected an evaluated run with {name} in {run}, found none; run `scene-experts eval {run}` first")
    config, results = read_config(run), load_results(run)
    if results.get("step", config.train.iterations) != config.train.iterations:
        raise InputError(
            f"expected scores after all {config.train.iterations:,} iterations in {run}, found scores after {results['step']:,}; "
            f"finish the training with `scene-experts train --resume` and the run's own flags, then run `scene-experts eval {run}`"
        )
    if config.max_memory > 0:
        raise InputError(
            f"expected a run whose growth memory does not limit, found --max-memory {config.max_memory:g} in {run}; train without it"
        )
    with guarding(run, RUN):
        return _make_record(run, scene, config, results, code)


def _make_record(run: Path, scene: str, config: RunConfig, results: dict[str, Any], code: str) -> Record:
    views = read_json(run / "per_view.json", "scores by view")
    per_view = {name: {k: facts[k] for k in PER_VIEW if facts.get(k) is not None} for name, facts in views.items()}
    check_means(results, per_view, f"in {run}", f"run `scene-experts eval {run}` again")
    return Record(
        scene=scene,
        config=config,
        results=results,
        per_view=per_view,
        curves=read_curves(run / "metrics.jsonl"),
        code=code,
    )


def check_means(results: dict[str, Any], per_view: dict[str, dict[str, Any]], where: str, advice: str) -> None:
    """Raise InputError where a mean score is not that of the scores by view: one of both is of another evaluation, or was edited."""
    for metric in MEANS:
        scores = [facts[metric] for facts in per_view.values() if metric in facts]
        if scores and results.get(metric) is not None and abs(fmean(scores) - results[metric]) > 1e-6:
            raise InputError(f"expected scores by view with the mean {metric} of the results {where}, found others; {advice}")


def read_curves(path: Path) -> list[dict[str, Any]]:
    """Read up to POINTS lines of a metrics file, evenly spread, with the last line among them."""
    lines = []
    for found in read_json_lines(path) if path.is_file() else []:
        psnr = found.get("psnr")
        if isinstance(psnr, (int, float)) and math.isfinite(psnr):
            lines.append({k: found[k] for k in CURVES if k in found})
    if len(lines) <= POINTS:
        return lines
    return [lines[round(i * (len(lines) - 1) / (POINTS - 1))] for i in range(POINTS)]


def record_path(store: Path, record: Record) -> Path:
    return store / record.scene / record.recipe / f"seed{record.seed}-{record.key}.json"


def write(store: Path, record: Record) -> Path:
    """Write a record with hashes of its configuration and its results; return its path."""
    config = to_json(record.config)
    config["data"]["path"] = record.scene  # do not publish where the capture was
    config["command"] = ""
    if start := config.pop("init_from"):
        config["init_from"] = Path(start).name
    results = without_places(record.results)
    value = {
        "scene": record.scene,
        "key": record.key,
        "config_sha256": digest(config),
        "results_sha256": digest(results),
        "config": config,
        "results": results,
        "per_view": record.per_view,
        "curves": record.curves,
    }
    if record.code:
        value["code"] = record.code
    path = record_path(store, record)
    write_bytes(path, pack(value).encode())
    return path


def without_places(results: dict[str, Any]) -> dict[str, Any]:
    """Return the results with the names of the files of LPIPS's weights alone: where they were on a machine is not published."""
    found = results.get("lpips_weights", {})
    named = {net: place[: len("cache ")] * place.startswith("cache ") + re.split(r"[/\\]", place)[-1] for net, place in found.items()}
    return {**results, "lpips_weights": named} if named else results


def pack(value: dict[str, Any]) -> str:
    """Return the text of a record file: scores by view and curves as columns, one entry a line."""
    views, curves = value["per_view"], value["curves"]
    scores = {"names": list(views), "scores": columns(list(views.values()))}
    return text({"format": FORMAT, **value, "per_view": scores, "curves": columns(curves)}) + "\n"


def unpack(value: dict[str, Any]) -> dict[str, Any]:
    """Return the value that `pack` was given, from the JSON of either format."""
    if value["format"] == 1:
        return value
    views, curves = value["per_view"], value["curves"]
    scores = dict(zip(views["names"], rows(views["scores"], len(views["names"])), strict=True))
    return {**value, "per_view": scores, "curves": rows(curves, length(curves))}


def read(path: Path) -> Record:
    """Read a record file. Raises InputError where it is something else or was edited by hand."""
    with guarding(path, JSON, "record of a run"):
        return _read(path)


def _read(path: Path) -> Record:
    value = read_json(path, "record of a run")
    parts = {"scene", "config", "results", "per_view", "curves", "config_sha256", "results_sha256"}
    if not isinstance(value, dict) or value.get("format") not in (1, FORMAT) or not parts <= value.keys():
        raise InputError(f"expected a record of a run (format {FORMAT}) in {path}, found something else; remove it and reproduce again")
    for part in ("config", "results"):
        if digest(value[part]) != value[f"{part}_sha256"]:
            raise InputError(f"expected {part} with the recorded checksum in {path}, found edited values; remove it and reproduce again")
    try:
        value = unpack(value)
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"expected columns of equal length in {path}, found others ({error}); remove it and reproduce again") from error
    scene, results, per_view, curves = (value[name] for name in ("scene", "results", "per_view", "curves"))
    code = value.get("code", "")
    kinds = (isinstance(scene, str), isinstance(code, str), isinstance(results, dict), isinstance(per_view, dict), isinstance(curves, list))
    if not all(kinds):
        raise Damaged("a scene, results, scores or curves of another form")
    check_means(results, per_view, f"in {path}", "remove it and reproduce again")
    return Record(scene, from_json(RunConfig, value["config"]), results, per_view, curves, code)


def load(store: Path) -> list[Record]:
    """Read every record below a folder, in the order of their paths."""
    return [read(path) for path in sorted(store.glob("*/*/seed*.json"))]


def load_like(store: Path, spec: Spec) -> list[Record]:
    """Read the records of a run's scene and seed: `find` needs no others, and reading all takes seconds."""
    return [read(path) for path in sorted((store / spec.scene.name).glob(f"*/seed{spec.seed}-*.json"))]


def digest(value: Any) -> str:
    """Return the SHA-256 of a JSON value, whatever the order of its keys."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def find(records: Sequence[Record], spec: Spec) -> Record | None:
    """Find the record of a run, or one with the same numbers under the name of another recipe."""
    key, numbers = spec.key, spec.numbers
    found = next((r for r in records if r.key == key), None) or next((r for r in records if r.numbers == numbers), None)
    return found and replace(found, config=replace(found.config, train=spec.train))


def find_all(records: Sequence[Record], specs: Sequence[Spec]) -> list[Record]:
    """Find the records of those runs that are done."""
    return [record for spec in specs if (record := find(records, spec))]


def check_captures(records: Sequence[Record], specs: Sequence[Spec]) -> None:
    """Raise InputError where a record of `specs` belongs to another capture of that name: it was scored on other views than its capture
    holds out, had another number of 3D points or other camera poses, as after new structure from motion.

    Checks the views of one run of each scene, and the points and poses of all. Captures that cannot be read are skipped here; their
    training reports the error.
    """
    by_scene: dict[str, list[tuple[Spec, Record]]] = {}
    for spec in specs:
        if record := find(records, spec):
            by_scene.setdefault(spec.scene.name, []).append((spec, record))
    for pairs in by_scene.values():
        spec, record = pairs[-1]
        try:
            capture = load_capture(spec.data)
        except InputError:
            continue
        capture.images.close()
        advice = "rename the folder, or give it its own --records"
        there, scored = sorted(capture.views[i].name for i in capture.test), sorted(record.per_view)
        if there != scored:
            raise InputError(
                f"expected records of '{spec.scene.name}' with the views that {spec.scene.path} holds out ({few(there)}), "
                f"found scores of {few(scored)} from another capture of that name; {advice}"
            )
        known = 0 if capture.points is None else len(capture.points.xyz)
        counts = {record.results.get("points", known) for _, record in pairs} - {known}  # older records have no number of points
        if counts:
            raise InputError(
                f"expected records of '{spec.scene.name}' with the {known:,} points of {spec.scene.path}, found {counts.pop():,} in a "
                f"record: its camera poses were others; {advice}"
            )
        poses = capture.poses()
        if not all(same_poses(record.results.get("poses"), poses) for _, record in pairs):  # older records have no poses
            raise InputError(
                f"expected records of '{spec.scene.name}' with the camera poses of {spec.scene.path}, found others in a record; {advice}"
            )
