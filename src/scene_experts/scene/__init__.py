"""Scenes: what a camera looks at and what a training changes. The interface that training, evaluation and export use."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from torch import Tensor, nn

from scene_experts.core.errors import InputError
from scene_experts.core.parts import Part
from scene_experts.core.schedule import Rate
from scene_experts.core.table import Table
from scene_experts.core.types import Camera, Decoded, Mode, Points, Routing

if TYPE_CHECKING:
    from scene_experts.scene.anchors.appearance import Codes

Cull = Callable[[Tensor, Tensor, Camera], Tensor]
"""The rasteriser's visibility test: means [n, 3], scales [n, 3], camera -> [n] bool."""
Draws = Callable[[Camera, int, Mode, Cull], Decoded]
"""What a scene does when it is called: (camera, step, mode, cull) -> Decoded."""


@dataclass(frozen=True)
class Traits:
    """What a scene is and can do. Other parts read these values and never ask for the scene's class."""

    family: str
    """Key of the scene's family: "anchors", "gaussians", "graph". `files` looks up readers and writers by it."""
    rows: str
    """What one row of the table is called, in the plural: "anchors", "Gaussians", "points"."""
    voxel: float = 0.0
    """Edge of the finest lattice cell that rows lie on, trained world units; 0: rows lie on no lattice."""
    experts: int = 0
    """Experts per attribute; 0: the scene has no mixture of experts."""
    levels: int = 0
    """Levels of detail; 0: the scene has none. `Scene.at_level` draws fewer of them."""
    activation: bool = False
    """A network decides each Gaussian's opacity, so a view has an activation ratio (share of Gaussians with positive opacity)."""
    sh_degree: int | None = None
    """Degree of the spherical harmonics where each row is a standard Gaussian; None where shape or opacity depend on the camera."""
    appearance: int = 0
    """Size of the appearance code of each training view; 0: the scene has no codes."""

    @property
    def needs_bake(self) -> bool:
        """Whether the rows must be baked before they are standard Gaussians."""
        return self.sh_degree is None


class Scene(nn.Module):
    """Rows of a table that decode into Gaussians for a camera. A family subclasses it; the defaults suit a scene without extras."""

    table: Table
    extent: float

    codes: Codes | None  # appearance codes; None where `traits.appearance` is 0

    def __init__(self, table: Table, extent: float) -> None:
        """extent: the capture's R, trained world units."""
        super().__init__()
        self.table, self.extent = table, extent
        self.codes = None

    @property
    @abstractmethod
    def traits(self) -> Traits:
        """What this scene is and can do."""

    @property
    @abstractmethod
    def K(self) -> int:
        """Gaussians per row."""

    @property
    @abstractmethod
    def file_values(self) -> int:
        """float32 values of a row in the file of the scene's family."""

    @property
    @abstractmethod
    def positions(self) -> Tensor:
        """Where the rows are, [N, 3], trained world."""

    @abstractmethod
    def forward(self, camera: Camera, step: int, mode: Mode, cull: Cull) -> Decoded:
        """The Gaussians that `camera` sees at `step`. `cull(means, scales, camera)` is the rasteriser's visibility test."""

    @abstractmethod
    def rate_groups(self) -> dict[str, list[nn.Parameter]]:
        """Every parameter, by the name of its learning rate."""

    @abstractmethod
    def meta(self) -> dict[str, Any]:
        """The plain values that a checkpoint keeps to build the scene again (`voxel`, `extent`, ...)."""

    def network_tensors(self) -> dict[str, Tensor]:
        """Every learned tensor that is not a column of the table, by name."""
        return {}

    def routing(self, step: int, most: int | None = None, mode: Mode = Mode.DRAW) -> dict[str, Routing]:
        """Routing of every row (of at most `most` rows, evenly spread), by attribute; empty without experts."""
        return {}

    def scene_opacity(self, camera: Camera, step: int, mode: Mode = Mode.DRAW) -> Tensor | None:
        """Raw opacities [N, K] of every row from `camera`, seen or not; None where no network decides opacities."""
        return None

    def rows_by_level(self) -> list[int]:
        """How many rows each level of detail holds, coarse to fine; empty without levels."""
        return []

    def at_level(self, level: int | None) -> AbstractContextManager[None]:
        """Within the block the scene draws no finer level than `level` (0 is the coarsest; None: all).

        A scene without levels draws as always.
        """
        return nullcontext()

    def frozen(self, step: int) -> Draws:
        """The scene prepared for drawing at `step` without gradients: the same pictures, faster. Do not train it meanwhile."""
        return self


class LatticeScene(Scene):
    """A scene whose rows lie at the cells of a lattice; growth adds rows at empty cells. The table has a fact `cell` [N, 3] int64."""

    voxel: float  # edge of the finest lattice cell, trained world units

    @abstractmethod
    def new_rows(self, cells: Tensor, size: float, feature: Tensor, level: int = 0) -> dict[str, Tensor]:
        """Columns of new rows at cells [n, 3] of `level`, with scaling `size` and features [n, F]."""

    @abstractmethod
    def slot_points(self, slots: Tensor, rows: Tensor) -> Tensor:
        """Where the Gaussians of flat `slots` [P] (row * K + slot) of `rows` [P] are, [P, 3] float64."""


@dataclass(frozen=True)
class SceneConfig(Part, ABC):
    """What a scene is made of; its fields are the recipe's flags under --scene."""

    family: ClassVar[str]
    """Key of the family, as in `Traits.family`."""

    @property
    @abstractmethod
    def grown_as(self) -> str:
        """What growth rules for this scene name in `Strategy.grows`, for example "anchors on levels"."""

    @property
    def dense_until(self) -> int:
        """The last iteration of the experts' dense warm-up; 0 without one."""
        return 0

    @abstractmethod
    def start(self, points: Points, extent: float, cameras: Sequence[Camera] = ()) -> Scene:
        """A new scene from a point cloud and the cameras of the training views; some families do not need the cameras."""

    @abstractmethod
    def load(self, table: Table, meta: dict[str, Any]) -> Scene:
        """The scene that a checkpoint's table and `Scene.meta()` describe; the caller fills in the tensors of its networks."""


@dataclass(frozen=True)
class LearningRates(Part, ABC):
    """Learning rates of a family's scenes: one `Rate` for each group of `Scene.rate_groups`; flags under --rates."""

    family: ClassVar[str]
    """Key of the family, as in `Traits.family`."""

    @abstractmethod
    def at(self, group: str, step: int, total: int, extent: float) -> float:
        """The rate of `group` at `step` of `total`; extent: the scene's R, trained world units."""

    def check(self) -> None:
        """Raises InputError, naming the flag, for a rate that is not positive throughout or 0 throughout."""
        for name, rate in vars(self).items():
            if isinstance(rate, Rate) and not (rate.first > 0 < rate.last or rate.first == rate.last == 0):
                flag = f"--rates.{name.replace('_', '-')}"
                raise InputError(f"expected {flag} to run between two rates above 0, or to be 0, found {rate.first} and {rate.last}")
