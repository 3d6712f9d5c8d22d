"""The files of scenes of graph points: a result folder in SAGS's layout."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from scene_experts.files.graph import write as writing
from scene_experts.files.registry import Imported

if TYPE_CHECKING:
    from scene_experts.data.settings import Data
    from scene_experts.data.views import World
    from scene_experts.training.run_folder import OpenRun


class GraphFiles:
    """See `registry.Family`. There is no file format with these contents beside the result
    folder."""

    describe = staticmethod(writing.describe)
    contents = staticmethod(writing.contents)
    write = staticmethod(writing.write)

    def warnings(self, run: OpenRun) -> list[str]:
        """None: no other program reads these networks."""
        return []

    def find(self, source: Path, iteration: int | None) -> Path | None:
        from scene_experts.files.graph.read import find

        return find(source, iteration)

    def read(self, source: Path, data: Data | None, iteration: int | None) -> Imported:
        from scene_experts.files.graph.read import read

        return read(source, data, iteration)

    def scene(self, run: OpenRun, contents: Any, world: World) -> NoReturn:
        raise NotImplementedError("no format holds graph points")


FAMILY = GraphFiles()
