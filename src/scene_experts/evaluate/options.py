"""What is scored: the options of `scene-experts eval`, of the Python API and of `evaluate`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal


@dataclass(frozen=True)
class EvalOptions:
    """Which views are scored, and with which metrics."""

    views: Literal["test", "train"] = "test"
    """Which views to score: the held-out views, or the training views."""
    appearance: Literal["rule", "half"] = "rule"
    """For scenes with appearance codes. rule: held-out views use the code that the recipe chooses.
    half: the code is fitted to the left half of each photograph and the right half is scored
    (protocol of NeRF in the Wild); the results get files of their own."""
    lpips: bool = True
    """Score LPIPS if its weights are on this machine."""
    lpips_weights: Path | None = None
    """File or folder of the LPIPS weights."""
    download_lpips: bool = False
    """Download the LPIPS weights if they are not on this machine."""
    align_poses: bool = False
    """Move each held-out camera to where its photograph fits the scene best, before it is scored.
    Always done for a run of `train --refine-poses`, and stated in the results."""

    @property
    def folder(self) -> str:
        """Name of the folder of the pictures in the run folder."""
        return f"{self.views}_half" if self.appearance == "half" else self.views

    @property
    def suffix(self) -> str:
        """Ending of the names of the results: results{suffix}.json, per_view{suffix}.json."""
        return "_half" if self.appearance == "half" else "" if self.views == "test" else f"_{self.views}"
