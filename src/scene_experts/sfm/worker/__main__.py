"""Serves one request."""

from __future__ import annotations

import json
import os
import sys
import threading

from scene_experts.sfm.worker.features import extract_features
from scene_experts.sfm.worker.lenses import estimate_all
from scene_experts.sfm.worker.mappers import has_wide_pair
from scene_experts.sfm.worker.matches import add_learned, match_all
from scene_experts.sfm.worker.messages import report
from scene_experts.sfm.worker.poses import estimate_poses
from scene_experts.sfm.worker.rigs import tie_views


def exit_with_parent() -> None:
    """End this process when its parent ends, which closes standard input."""
    sys.stdin.read()
    os._exit(1)


def main() -> int:
    """Serve one request and return the exit code."""
    ask = json.loads(sys.stdin.readline())
    try:
        import pycolmap as colmap
    except ImportError as error:
        report(step="missing", why=str(error))
        return 0
    threading.Thread(target=exit_with_parent, daemon=True).start()
    colmap.set_random_seed(ask["seed"])
    large = False
    if ask["learned"]:
        add_learned(colmap, ask)
    else:
        large = extract_features(colmap, ask)
        if ask["pairs"] is not None:
            match_all(colmap, ask)
    if not ask["poses"]:
        report(step="done")
        sys.stdout.flush()
        os._exit(0)
    if ask["rig"] is not None:
        tie_views(colmap, ask)
    ask["narrow"] = ask["rig"] is None and ask["mapper"] != "global" and not has_wide_pair(colmap, ask)
    estimate = estimate_all if ask["camera_model"] == "OPENCV" and ask["rig"] is None else estimate_poses
    report(step="done", version=colmap.__version__, large_features=large, **estimate(colmap, ask))
    sys.stdout.flush()
    os._exit(0)  # the waiting thread would delay the end of the interpreter


if __name__ == "__main__":
    sys.exit(main())
