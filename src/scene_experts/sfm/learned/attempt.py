"""Decides whether photographs are matched by learned features too, and which result is kept.

The learned features are added to those that COLMAP has found, so that nothing is lost where those
fit.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from scene_experts.core.errors import InputError
from scene_experts.core.progress import Progress
from scene_experts.sfm.learned import photographs
from scene_experts.sfm.learned.weights import INSTALL, find_weights, load_networks
from scene_experts.sfm.options import Features
from scene_experts.sfm.pairs import MOST_EXHAUSTIVE
from scene_experts.sfm.worker.poses import ENOUGH

MOST = 3000  # pairs, unless asked for: nearly an hour of a core

Worker = Callable[[dict[str, Any]], dict[str, Any]]
"""Runs COLMAP for a request and returns its last message."""


def check_features(features: Features) -> None:
    """Raise InputError if learned features are asked for and their weights are not installed."""
    if features == "learned" and find_weights() is None:
        raise InputError(f"--features learned needs the weights of ALIKED and LightGlue, found none: {INSTALL}")


def is_wanted(features: Features, result: dict[str, Any], total: int, say: Callable[[str], None]) -> bool:
    """Return whether learned features are tried after COLMAP's own features led to `result`; say why,
    or how they are installed.

    Poses of the global mapper do not count: where the incremental mapper fails, that one may give
    every photograph a pose, and wrong ones.
    """
    lacking = len(result.get("lacking", []))
    if features != "auto" or total - lacking >= ENOUGH * total:
        return False
    left = f"the first mapper left {lacking} of {total} photographs without a pose"
    if find_weights() is None:
        say(f"{left}; learned features may connect them: {INSTALL}, then make the capture anew")
        return False
    say(f"{left}; learned features (ALIKED and LightGlue) are tried too, and the better result is kept")
    return True


def choose_pairs(
    pairs: Sequence[tuple[int, int]], spare: Sequence[tuple[int, int]], names: Sequence[str], lacking: Sequence[str]
) -> list[tuple[int, int]]:
    """Return the pairs that are matched by learned features, of those that COLMAP has matched: all of
    few photographs, otherwise those with a photograph in `lacking`. Of more than MOST, those in
    `spare` are left out, and of the others MOST are taken, evenly spread."""
    if len(names) <= MOST_EXHAUSTIVE:
        return sorted({*pairs, *spare})
    without = set(lacking)
    some = [pair for pair in sorted({*pairs, *spare}) if without.intersection(names[i] for i in pair)]
    if len(some) > MOST:
        some = sorted({*some}.intersection(pairs))
    return some if len(some) <= MOST else [some[k * len(some) // MOST] for k in range(MOST)]


def reconstruct_with(
    shots: photographs.Shots,
    pairs: Sequence[tuple[int, int]],
    request: dict[str, Any],
    run: Worker,
    say: Callable[[str], None],
    progress: Progress,
) -> dict[str, Any]:
    """Find learned features, match the pairs, and return COLMAP's result with them. `request` is
    that of the poses, with places of its own for what is written.

    Raises InputError if the weights are missing or damaged, RunError if COLMAP fails.
    """
    finder, matcher = load_networks()
    say(f"learned features: {len(pairs):,} pairs to match, about a second of a core each")
    photographs.find_features(shots, finder, progress)
    photographs.find_matches(shots, pairs, matcher, progress)
    arrays = shots.folder / "all.npz"
    photographs.write_for_colmap(shots, pairs, arrays)
    return run({**request, "learned": str(arrays), "names": list(shots.names), "poses": True})


def keep_better(
    one: dict[str, Any], other: dict[str, Any], total: int, models: tuple[Path, Path], say: Callable[[str], None]
) -> dict[str, Any]:
    """Return the result that is kept: `one` of COLMAP's features or `other`, with learned ones. Its
    model is moved to the first of the `models`.

    `other` needs more poses than the first mapper found for `one`, and as many as its second:
    otherwise COLMAP's own result stays, as it is without the networks. total: Number of photographs.
    """
    poses = [(len(result["registered"]), result.get("points", 0)) for result in (one, other)]
    say("poses: " + ", ".join(f"{count} with {points:,} points from {what}" for (count, points), what in zip(poses, KINDS, strict=True)))
    if poses[1][0] <= total - len(one["lacking"]) or poses[1][0] < poses[0][0]:
        say("the result without learned features is kept")
        return one
    say("the result with learned features is kept")
    if models[0].exists():
        shutil.rmtree(models[0])
    models[1].rename(models[0])
    return {**other, "features": "SIFT and ALIKED"}


KINDS = ("COLMAP's features", "these and learned ones")
