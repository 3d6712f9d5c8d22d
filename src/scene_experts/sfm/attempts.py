"""Poses by one way after the other: COLMAP's features without the smallest ones and with them, then
learned features, and the result that is kept."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from scene_experts.core.errors import InputError, RunError
from scene_experts.core.progress import Progress
from scene_experts.sfm import work
from scene_experts.sfm.colmap import Say
from scene_experts.sfm.learned import attempt
from scene_experts.sfm.learned.photographs import Shots
from scene_experts.sfm.options import SfmOptions
from scene_experts.sfm.worker.poses import ENOUGH


def find_poses(
    request: dict[str, Any],
    shots: Shots,
    pairs: list[tuple[int, int]],
    spare: list[tuple[int, int]],
    options: SfmOptions,
    maps: Path,
    run: attempt.Worker,
    say: Say,
    progress: Progress,
) -> dict[str, Any]:
    """Find poses by COLMAP's features, by learned ones too, or by one after the other, and return
    the result that is kept.

    pairs: To match, as places in `shots.names`; spare: those for photographs that fit too few. maps:
    Folder of COLMAP's models. run: Calls the worker.
    """
    if options.features == "learned":
        run({**request, "poses": False})
        return {**attempt.reconstruct_with(shots, pairs, request, run, say, progress), "features": "SIFT and ALIKED"}
    result, request = use_own_features(request, maps, run, say)
    if not attempt.is_wanted(options.features, result, len(shots.names), say):
        return result
    model, mapper = Path(request["model"]), "incremental" if options.mapper == "auto" else options.mapper
    again = {**request, "maps": str(maps / "learned"), "model": str(maps / "learned-model"), "mapper": mapper}
    some = attempt.choose_pairs(pairs, spare, shots.names, result["lacking"])
    try:
        other = attempt.reconstruct_with(shots, some, again, run, say, progress)
    except (InputError, RunError) as error:
        say(f"warning: the result without learned features is kept, because they failed: {error}")
        return result
    return attempt.keep_better(result, other, len(shots.names), (model, Path(again["model"])), say)


def use_own_features(request: dict[str, Any], maps: Path, run: attempt.Worker, say: Say) -> tuple[dict[str, Any], dict[str, Any]]:
    """Find poses by COLMAP's features. Where those without the smallest were asked for and leave more
    than a tenth of the photographs without a pose, the smallest are added. Returns the result and
    the request that led to it."""
    if request["enough"] is None:
        return run(request), request
    result = run({**request, "mapper": "incremental"} if request["mapper"] == "auto" else request)
    total = sum(map(len, request["groups"]))
    if len(result["registered"]) >= ENOUGH * total:
        return result, request
    if result["large_features"]:
        say(f"{total - len(result['registered'])} of {total} photographs have no pose yet: smaller features are searched for, too")
    for left in (maps, Path(request["model"])):
        work.remove(left)
    database = request["database"] + ".all" if result["large_features"] else request["database"]
    request = {**request, "database": database, "enough": None}
    return run(request), request


def warn_of_mapper(result: dict[str, Any], options: SfmOptions) -> str | None:
    """Return a warning if the poses are those of the global mapper after the incremental one had
    failed: it may give every photograph a pose, and wrong ones."""
    if options.mapper != "auto" or result.get("mapper") != "global" or result.get("one_focal_length"):
        return None
    return (
        "warning: these poses are those of the global mapper, because the incremental one fitted too few photographs together; "
        "they may be wrong: look at the scene, or take photographs between these"
    )
