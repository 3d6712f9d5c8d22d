"""What is kept of a run: one JSON record with its configuration, results, scores per view and how its experts were used over training.

Records are small and say everything a table or figure needs, so they can be committed where run folders and checkpoints cannot.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from scene_experts.core.errors import InputError, few
from scene_experts.core.io import read_json, write_bytes
from scene_experts.evaluate.tables import load_results
from scene_experts.reproduce.columns import columns, length, rows, text
from scene_experts.reproduce.plan import Spec, identity
from scene_experts.training.config import RunConfig, from_json, to_json
from scene_experts.training.run_folder import load_capture, read_config

FORMAT = 2
POINTS = 60  # samples of a curve over training
CURVES = ("step", "seconds", "psnr", "anchors", "active", "routing", "entropy", "scene_routing", "scene_gates")
PER_VIEW = ("psnr", "ssim", "lpips", "lpips_3dgs", "activation_ratio", "gaussians_rendered")


@dataclass(frozen=True)
class Record:
    """One finished run."""

    scene: str
    config: RunConfig
    results: dict[str, Any]
    per_view: dict[str, dict[str, Any]]
    curves: list[dict[str, Any]]  # step, seconds, anchors, active, routing of some iterations

    @cached_property
    def key(self) -> str:
        return identity(self.scene, self.config.train, self.config.data)

    @cached_property
    def numbers(self) -> str:
        """As `Spec.numbers`."""
        return identity(self.scene, replace(self.config.train, recipe=""), self.config.data)

    @property
    def recipe(self) -> str:
        return self.config.train.recipe

    @property
    def seed(self) -> int:
        return self.config.train.seed

    def value(self, column: str) -> float | None:
        """A column of a table: psnr, ssim, lpips_3dgs, size_mb, active_percent, train_seconds, ..."""
        r = self.results
        if column == "size_mb":
            return r["size"]["MB"]
        if column == "active_percent":
            return None if r.get("activation_ratio") is None else 100 * r["activation_ratio"]
        return r.get(column)


def of_run(run: Path, scene: str) -> Record:
    """The record of an evaluated run folder. Raises InputError where it is not whole, or its training was scored before its end."""
    for name in ("config.json", "results.json", "per_view.json"):
        if not (run / name).is_file():
            raise InputError(f"expected an evaluated run with {name} in {run}, found none; run `scene-experts eval {run}` first")
    config, results = read_config(run), load_results(run)
    if results.get("step", config.train.iterations) != config.train.iterations:
        raise InputError(
            f"expected the scores of all {config.train.iterations:,} iterations in {run}, found those after {results['step']:,}; "
            f"run `scene-experts train --resume` with the run's own flags to its end, then `scene-experts eval {run}`"
        )
    views = read_json(run / "per_view.json", "scores by view")
    return Record(
        scene=scene,
        config=config,
        results=results,
        per_view={name: {k: facts[k] for k in PER_VIEW if facts.get(k) is not None} for name, facts in views.items()},
        curves=curves(run / "metrics.jsonl"),
    )


def curves(path: Path) -> list[dict[str, Any]]:
    """At most POINTS lines of a training's metrics, evenly spread, the last one among them."""
    lines = []
    for line in path.read_text(errors="replace").splitlines() if path.is_file() else []:
        try:
            found = json.loads(line)
        except ValueError:
            continue  # cut off by a crash
        if isinstance(found, dict) and math.isfinite(found.get("psnr", math.nan)):
            lines.append({k: found[k] for k in CURVES if k in found})
    if len(lines) <= POINTS:
        return lines
    return [lines[round(i * (len(lines) - 1) / (POINTS - 1))] for i in range(POINTS)]


def path_of(store: Path, record: Record) -> Path:
    return store / record.scene / record.recipe / f"seed{record.seed}-{record.key}.json"


def write(store: Path, record: Record) -> Path:
    """Write a record, with hashes of its configuration and its results."""
    config = to_json(record.config)
    config["data"]["path"] = record.scene  # where the capture lay is nobody's business
    config["command"] = ""
    value = {
        "format": FORMAT,
        "scene": record.scene,
        "key": record.key,
        "config_sha256": digest(config),
        "results_sha256": digest(record.results),
        "config": config,
        "results": record.results,
        "per_view": record.per_view,
        "curves": record.curves,
    }
    path = path_of(store, record)
    write_bytes(path, packed(value).encode())
    return path


def packed(value: dict[str, Any]) -> str:
    """The text of a record: scores by view and curves as columns, an entry a line."""
    views, curve = value["per_view"], value["curves"]
    scores = {"names": list(views), "scores": columns(list(views.values()))}
    return text({**value, "format": FORMAT, "per_view": scores, "curves": columns(curve)}) + "\n"


def unpacked(value: dict[str, Any]) -> dict[str, Any]:
    """The same with a row for each view and each point of a curve, as format 1 has it."""
    if value["format"] == 1:
        return value
    views, curve = value["per_view"], value["curves"]
    scores = dict(zip(views["names"], rows(views["scores"], len(views["names"])), strict=True))
    return {**value, "per_view": scores, "curves": rows(curve, length(curve))}


def read(path: Path) -> Record:
    """A record file. Raises InputError where it is none, or was changed by hand."""
    value = read_json(path, "record of a run")
    parts = {"scene", "config", "results", "per_view", "curves", "config_sha256", "results_sha256"}
    if not isinstance(value, dict) or value.get("format") not in (1, FORMAT) or not parts <= value.keys():
        raise InputError(f"expected a record of a run (format {FORMAT}) in {path}, found something else; remove it and reproduce again")
    for part in ("config", "results"):
        if digest(value[part]) != value[f"{part}_sha256"]:
            raise InputError(f"expected {part} as they were written in {path}, found them changed; remove it and reproduce again")
    try:
        value = unpacked(value)
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"expected columns of equal length in {path}, found others ({error}); remove it and reproduce again") from error
    return Record(value["scene"], from_json(RunConfig, value["config"]), value["results"], value["per_view"], value["curves"])


def load(store: Path) -> list[Record]:
    """Every record below a folder, in order of their paths."""
    return [read(path) for path in sorted(store.glob("*/*/seed*.json"))]


def digest(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def find(records: Sequence[Record], spec: Spec) -> Record | None:
    """The record of exactly this run if it is done, or of one with the same numbers under another recipe's name."""
    key, numbers = spec.key, spec.numbers
    found = next((r for r in records if r.key == key), None) or next((r for r in records if r.numbers == numbers), None)
    return found and replace(found, config=replace(found.config, train=spec.train))


def expect_of_captures(records: Sequence[Record], specs: Sequence[Spec]) -> None:
    """Raises InputError where a record that counts as one of `specs` scored other views than its capture holds out: another of that name.

    One run of each scene is looked at. A capture that cannot be read is for its training to complain about.
    """
    for spec, record in {spec.scene.name: (spec, record) for spec in specs if (record := find(records, spec))}.values():
        try:
            capture = load_capture(spec.data)
        except InputError:
            continue
        capture.images.close()
        there, scored = sorted(capture.views[i].name for i in capture.test), sorted(record.per_view)
        if there != scored:
            raise InputError(
                f"expected records of '{spec.scene.name}' with the views that {spec.scene.path} holds out ({few(there)}), "
                f"found scores of {few(scored)}, so of another capture of that name; rename the folder, or give it --records of its own"
            )


def of_specs(records: Sequence[Record], specs: Sequence[Spec]) -> list[Record]:
    """The records of these runs, as far as they are done."""
    return [record for spec in specs if (record := find(records, spec))]
