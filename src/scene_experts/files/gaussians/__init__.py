"""The files of scenes of explicit Gaussians: the result folder of 3DGS, and every format of
standard Gaussians in `formats`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from scene_experts.files.gaussians import write as writing
from scene_experts.files.registry import Imported

if TYPE_CHECKING:
    from scene_experts.data.settings import Data
    from scene_experts.data.views import World
    from scene_experts.scene import Scene
    from scene_experts.training.run_folder import OpenRun


class GaussianFiles:
    """See `registry.Family`. Contents are `Splats`."""

    describe = staticmethod(writing.describe)
    contents = staticmethod(writing.contents)
    write = staticmethod(writing.write)

    def warnings(self, run: OpenRun) -> list[str]:
        """None: every reader of 3DGS draws the same scene."""
        return []

    def find(self, source: Path, iteration: int | None) -> Path | None:
        from scene_experts.files.gaussians.read import find

        return find(source, iteration)

    def read(self, source: Path, data: Data | None, iteration: int | None) -> Imported:
        from scene_experts.files.gaussians.read import read

        return read(source, data, iteration)

    def scene(self, run: OpenRun, contents: Any, world: World) -> tuple[Scene, int]:
        from scene_experts.files.gaussians.read import scene

        return scene(run, contents, world)


FAMILY = GaussianFiles()
