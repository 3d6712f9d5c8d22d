"""The result folder of Scaffold-GS, with its networks.

This module states the files of scenes of anchors: this folder (`write`, `read`) and the compact
file (`compact`).
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from scene_experts.files.anchors import write as writing
from scene_experts.files.registry import Format, Imported

if TYPE_CHECKING:
    from scene_experts.data.settings import Data
    from scene_experts.data.views import World
    from scene_experts.scene import Scene
    from scene_experts.training.run_folder import OpenRun


class AnchorFiles:
    """See `registry.Family`. Contents are `AnchorData`."""

    describe = staticmethod(writing.describe)
    contents = staticmethod(writing.contents)
    write = staticmethod(writing.write)
    warnings = staticmethod(writing.warnings)

    def find(self, source: Path, iteration: int | None) -> Path | None:
        from scene_experts.files.anchors.read import find

        return find(source, iteration)

    def read(self, source: Path, data: Data | None, iteration: int | None) -> Imported:
        from scene_experts.files.anchors.read import read

        return read(source, data, iteration)

    def scene(self, run: OpenRun, contents: Any, world: World) -> tuple[Scene, int]:
        from scene_experts.files.anchors.read import scene

        return scene(run, contents, world)


FAMILY = AnchorFiles()
FORMAT = Format(suffix="", family="anchors")
