"""Records of finished runs: one JSON file a capture, with the configuration, results, scores by
view and curves of each run.

A record holds everything that the tables and figures need. It takes about 5 kB, so it can be
committed where checkpoints cannot. Its configuration states what differs from the defaults
(`core.plain.lean`).
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from statistics import fmean
from typing import Any

from scene_experts.core.errors import InputError, few
from scene_experts.core.io import read_json, waiting, write_bytes
from scene_experts.core.plain import UnknownPart, from_json, lean
from scene_experts.core.reading.budget import JSON, RUN, Damaged
from scene_experts.core.reading.plain import read_json_lines
from scene_experts.core.reading.source import guarding
from scene_experts.data import capture as captures
from scene_experts.data.views import same_poses
from scene_experts.evaluate.results import load_results
from scene_experts.reproduce.columns import columns, length, rows, text
from scene_experts.reproduce.plan import Spec, identity
from scene_experts.training.config import RunConfig
from scene_experts.training.run_folder import read_config

log: logging.Logger = logging.getLogger(__name__)
FORMAT = 3
DIGITS = 6  # decimals of numbers
SAMPLES = 60  # the most iterations whose PSNR counts in `Record.fit`
POINTS = 30  # the most points of a training curve
FILE = "file of records"
PARTS = ("key", "recipe", "seed", "config", "results", "per_view", "curves", "fit", "sha256")
"""What each run of a file has."""
MOST_EXPERTS = 16  # whose shares are kept: of more, they would be most of the file
CURVES = {"step": 0, "seconds": 1, "psnr": 3, "anchors": 0, "scene_routing": 3}
"""Columns of a curve, and their decimals."""
MEANS = ("psnr", "ssim", "lpips", "lpips_3dgs")
PER_VIEW = (*MEANS, "activation_ratio", "gaussians_rendered")


@dataclass(frozen=True)
class Record:
    """One finished run.

    `results` is its results.json. `per_view` maps the name of a held-out view to its scores
    (PER_VIEW). `curves` holds the values of CURVES at up to POINTS iterations. `fit` is the mean
    PSNR (dB) of the training views over the second half of the training, at up to SAMPLES
    iterations in all; None where none was logged. `code` is a hash of the code of other packages
    that it was trained with (`plan.code_of`).
    """

    scene: str
    config: RunConfig
    results: dict[str, Any]
    per_view: dict[str, dict[str, Any]]
    curves: list[dict[str, Any]]
    fit: float | None = None
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
        """Return the value of a table's column, e.g. psnr (dB), size_mb (10^6 bytes),
        active_percent, train_seconds; None if unknown."""
        if column == "size_mb":
            return self.results["size"]["MB"]
        if column == "active_percent":
            share = self.results.get("activation_ratio")
            return None if share is None else 100 * share
        return self.results.get(column)


def read_run(run: Path, scene: str, code: str = "") -> Record:
    """Make the record of an evaluated run folder. Raises InputError where files are missing or the
    training was scored before its end."""
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
    lines = read_curves(run / "metrics.jsonl")
    return Record(scene, config, results, per_view, thin(lines), fit_of(lines, config.train.iterations), code)


def check_means(results: dict[str, Any], per_view: dict[str, dict[str, Any]], where: str, advice: str) -> None:
    """Raise InputError where a mean score is not that of the scores by view: one of both is of
    another evaluation, or was edited."""
    for metric in MEANS:
        scores = [facts[metric] for facts in per_view.values() if metric in facts]
        if scores and results.get(metric) is not None and abs(fmean(scores) - results[metric]) > 1e-6:
            raise InputError(f"expected scores by view with the mean {metric} of the results {where}, found others; {advice}")


def read_curves(path: Path) -> list[dict[str, Any]]:
    """Read up to SAMPLES lines of a metrics file, evenly spread, with the last line among them."""
    lines = []
    for found in read_json_lines(path) if path.is_file() else []:
        psnr = found.get("psnr")
        if isinstance(psnr, (int, float)) and math.isfinite(psnr):
            lines.append({k: found[k] for k in CURVES if k in found})
    return spread(lines, SAMPLES)


def fit_of(lines: Sequence[dict[str, Any]], iterations: int) -> float | None:
    """Return the mean PSNR (dB) of the training views in the second half of a training; None
    without any."""
    late = [line["psnr"] for line in lines if 2 * line["step"] > iterations]
    return fmean(late) if late else None


def thin(lines: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return up to POINTS of the lines, with the decimals of CURVES. Every second one has the
    shares of the experts, of at most MOST_EXPERTS."""
    found = [{name: rounded(value, CURVES[name]) for name, value in line.items()} for line in spread(lines, POINTS)]
    many = any(len(shares) > MOST_EXPERTS for line in found for shares in line.get("scene_routing", {}).values())
    return [{**line, "scene_routing": {}} if (many or i % 2) and "scene_routing" in line else line for i, line in enumerate(found)]


def spread(lines: Sequence[Any], most: int) -> list[Any]:
    """Return at most `most` of the lines, evenly spread, the first and the last among them."""
    if len(lines) <= most:
        return list(lines)
    return [lines[round(i * (len(lines) - 1) / (most - 1))] for i in range(most)]


def record_path(store: Path, scene: str) -> Path:
    """Return the file with the records of a capture."""
    return store / f"{scene}.json"


def write(store: Path, record: Record) -> Path:
    """Add a record to the file of its capture, in place of one of the same run; return the path of
    the file.

    Several processes, also of several machines, may write at once.
    """
    path = record_path(store, record.scene)
    path.parent.mkdir(parents=True, exist_ok=True)
    with waiting(path.with_name(f".{path.name}.lock")):
        found = {each["key"]: each for each in _read_runs(path)[1]} if path.is_file() else {}
        found[record.key] = pack(record)
        lines = (text(each, 0) for each in sorted(found.values(), key=lambda each: (each["recipe"], each["seed"], each["key"])))
        body = ",\n".join(lines)
        write_bytes(path, f'{{"format":{FORMAT},"scene":{json.dumps(record.scene)},"runs":[\n{body}\n]}}\n'.encode())
    return path


def pack(record: Record) -> dict[str, Any]:
    """Return the JSON of a record: what differs from the defaults, scores by view and curves as
    columns, and a checksum."""
    config = lean(replace(record.config, data=replace(record.config.data, path=Path(record.scene)), command="", versions={}))
    if start := config.pop("init_from", None):
        config["init_from"] = Path(start).name
    value = {
        "key": record.key,
        "recipe": record.recipe,
        "seed": record.seed,
        "config": config,
        "results": short_results(record.results),
        "per_view": {"names": list(record.per_view), "scores": columns(rounded(list(record.per_view.values())))},
        "curves": columns(record.curves),
        "fit": rounded(record.fit),
        **({"code": record.code} if record.code else {}),
    }
    return {**value, "sha256": digest(value)}


def short_results(results: dict[str, Any]) -> dict[str, Any]:
    """Return results as a record keeps them: shares of experts with 3 decimals, no places of a
    machine."""
    own = rounded(without_places(results))
    return {**own, "experts": rounded(own["experts"], 3)} if "experts" in own else own


def rounded(value: Any, digits: int = DIGITS) -> Any:
    """Return a JSON value whose numbers have at most `digits` decimals."""
    if isinstance(value, dict):
        return {name: rounded(each, digits) for name, each in value.items()}
    if isinstance(value, list):
        return [rounded(each, digits) for each in value]
    return round(value, digits) if isinstance(value, float) else value


def without_places(results: dict[str, Any]) -> dict[str, Any]:
    """Return the results with the names of the files of LPIPS's weights alone: where they were on a
    machine is not published."""
    found = results.get("lpips_weights", {})
    cached = {net: "cache " * place.startswith("cache ") for net, place in found.items()}
    named = {net: cached[net] + re.split(r"[/\\]", place.removeprefix(cached[net]))[-1] for net, place in found.items()}
    return {**results, "lpips_weights": named} if named else results


def read(path: Path) -> list[Record]:
    """Read the records of a file, without those of parts that compute something else by now
    (`Part.changes`), and, with a warning, without those of parts that are not installed.

    Raises InputError where it is something else or was edited by hand.
    """
    with guarding(path, JSON, FILE):
        found, unknown = [], []
        scene, runs = _read_runs(path)
        for value in runs:
            try:
                record = _unpack(path, scene, value)
            except UnknownPart as error:
                unknown.append(error)
                continue
            if record.key == value["key"]:
                found.append(record)
        if unknown:
            log.warning("left out %d of the records in %s: %s", len(unknown), path, unknown[0])
        return found


def _read_runs(path: Path) -> tuple[str, list[dict[str, Any]]]:
    """Return the name of the capture and the JSON of its runs."""
    value = read_json(path, FILE)
    version = value.get("format") if isinstance(value, dict) else None
    if isinstance(version, int) and version > FORMAT:
        raise InputError(f"expected a {FILE} of format {FORMAT} or older in {path}, found format {version}; update scene-experts")
    if version != FORMAT or not isinstance(value.get("scene"), str):
        raise InputError(f"expected a {FILE} (format {FORMAT}) in {path}, found something else; remove it and reproduce again")
    if not isinstance(value.get("runs"), list):
        raise Damaged("no list of runs")
    for run in value["runs"]:
        missing = [name for name in PARTS if not isinstance(run, dict) or name not in run]
        if missing:
            raise InputError(f"expected a {FILE} in {path}, found a run without {missing[0]}; remove it and reproduce again")
    return value["scene"], value["runs"]


def _unpack(path: Path, scene: str, value: dict[str, Any]) -> Record:
    own = {name: each for name, each in value.items() if name != "sha256"}
    if digest(own) != value["sha256"]:
        raise InputError(f"expected a run with its recorded checksum in {path}, found edited values; remove it and reproduce again")
    try:
        views, curves = value["per_view"], value["curves"]
        per_view = dict(zip(views["names"], rows(views["scores"], len(views["names"])), strict=True))
        points = rows(curves, length(curves))
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"expected columns of equal length in {path}, found others ({error}); remove it and reproduce again") from error
    results, fit, code = value["results"], value["fit"], value.get("code", "")
    if not (isinstance(results, dict) and isinstance(fit, (float, int, type(None))) and isinstance(code, str)):
        raise Damaged("results or a fit of another form")
    check_means(results, per_view, f"in {path}", "remove it and reproduce again")
    return Record(scene, from_json(RunConfig, value["config"]), results, per_view, points, fit, code)


def load(store: Path) -> list[Record]:
    """Read every record in a folder, in the order of captures, recipes and seeds."""
    return [record for path in sorted(store.glob("*.json")) for record in read(path)]


def load_like(store: Path, spec: Spec) -> list[Record]:
    """Read the records of a run's capture: `find` needs no others."""
    path = record_path(store, spec.scene.name)
    return read(path) if path.is_file() else []


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
    """Raise InputError where a record of `specs` belongs to another capture of that name: it was
    scored on other views than its capture holds out, had another number of 3D points or other
    camera poses, as after new structure from motion, or other photographs or masks.

    Checks the views of one run of each scene, and the rest of all. Captures that cannot
    be read are skipped here; their training reports the error.
    """
    by_scene: dict[str, list[tuple[Spec, Record]]] = {}
    for spec in specs:
        if record := find(records, spec):
            by_scene.setdefault(spec.scene.name, []).append((spec, record))
    for pairs in by_scene.values():
        spec, record = pairs[-1]
        try:
            capture = captures.load(spec.data)
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
        photographs = capture.photographs()
        if not all(record.results.get("photographs", photographs) == photographs for _, record in pairs):  # older records do not say
            raise InputError(
                f"expected records of '{spec.scene.name}' with the photographs and masks that are in {spec.scene.path} now, found a record "
                f"of others; {advice}"
            )
