"""Base classes of scenes: the interface that training, evaluation and export use."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, Self

import torch
from torch import Tensor, nn

from scene_experts.core.errors import InputError
from scene_experts.core.gradients import BackwardScene
from scene_experts.core.parts import Part
from scene_experts.core.table import Table
from scene_experts.core.types import Camera, Decoded, Mode, Points, Routing

if TYPE_CHECKING:
    from scene_experts.scene.anchors.appearance import Codes
    from scene_experts.scene.anchors.quantise import RowRounding
    from scene_experts.scene.exposure import Exposures
    from scene_experts.scene.poses import Poses

Cull = Callable[[Tensor, Tensor, Camera], Tensor]
"""The rasteriser's visibility test: means [n, 3], scales [n, 3], camera -> [n] bool."""
OPACITY = "an opacity network"
ROUTERS = "routers that losses train"
CODES = "appearance codes"
EXPERTS = "several experts"
EXPLICIT = "explicit Gaussians"
Draws = Callable[[Camera, int, Mode, Cull], Decoded]
"""Signature of a scene's forward pass: (camera, step, mode, cull) -> Decoded."""


@dataclass(frozen=True)
class Traits:
    """Properties and capabilities of a scene. Other modules read these values and never test the
    scene's class."""

    family: str
    """Key of the scene's family: "anchors", "gaussians", "graph". `files` looks up readers and
    writers by it."""
    rows: str
    """What one row of the table is called, in the plural: "anchors", "Gaussians", "points"."""
    voxel: float = 0.0
    """Edge of the finest lattice cell that rows lie on, trained world units; 0: rows lie on no
    lattice."""
    experts: int = 0
    """Experts per attribute; 0: the scene has no mixture of experts."""
    dense_until: int = 0
    """Last iteration of the experts' warm-up; 0 if there is none."""
    levels: int = 0
    """Levels of detail; 0: the scene has none. `Scene.at_level` draws fewer of them."""
    activation: bool = False
    """A network decides each Gaussian's opacity, so a view has an activation ratio (share of
    Gaussians with positive opacity)."""
    sh_degree: int | None = None
    """Degree of the spherical harmonics where each row is a standard Gaussian; None where shape or
    opacity depend on the camera."""
    appearance: int = 0
    """Size of the appearance code of each training view; 0: the scene has no codes."""

    @property
    def needs_bake(self) -> bool:
        """Whether the rows must be baked before they are standard Gaussians."""
        return self.sh_degree is None


class DirectScene(Protocol):
    """Draws training views without autograd."""

    def draw(self, camera: Camera, step: int, cull: Cull) -> tuple[Decoded, BackwardScene]:
        """Return the same as `Scene.forward` in `Mode.TRAIN`, without a graph, and the function that
        adds the gradients of the parameters to their `grad`."""
        ...


class Scene(nn.Module):
    """Rows of a table that decode into Gaussians for a camera. Each family has a subclass.

    The default methods suit a scene without experts, levels of detail or an opacity network.
    """

    table: Table
    extent: float

    dense_until: int = 0  # last iteration of the experts' dense warm-up; 0 without one
    codes: Codes | None  # appearance codes; None where `traits.appearance` is 0
    exposures: Exposures | None  # of the training photographs; None: all are taken to have one
    poses: Poses | None  # refined with the scene; None: those of the capture

    def __init__(self, table: Table, extent: float) -> None:
        """extent: the extent R of the capture, in trained world units."""
        super().__init__()
        self.table, self.extent = table, extent
        self.codes = None
        self.exposures = None
        self.poses = None

    @property
    @abstractmethod
    def traits(self) -> Traits:
        """Properties and capabilities of this scene."""

    @property
    @abstractmethod
    def K(self) -> int:
        """Gaussians per row."""

    @property
    @abstractmethod
    def file_values(self) -> int:
        """Number of float32 values per row in the family's file format."""

    @property
    @abstractmethod
    def positions(self) -> Tensor:
        """Positions of the rows [N, 3], in trained world units."""

    @abstractmethod
    def forward(self, camera: Camera, step: int, mode: Mode, cull: Cull) -> Decoded:
        """The Gaussians that `camera` sees at `step`. `cull(means, scales, camera)` is the
        rasteriser's visibility test."""

    @abstractmethod
    def rate_groups(self) -> dict[str, list[nn.Parameter]]:
        """All parameters, grouped by the name of their learning rate."""

    @abstractmethod
    def meta(self) -> dict[str, Any]:
        """Plain values that a checkpoint stores to rebuild the scene (`voxel`, `extent`, ...)."""

    def network_tensors(self) -> dict[str, Tensor]:
        """All learned tensors that are not columns of the table, by name."""
        return {}

    def routing(self, step: int, most: int | None = None, mode: Mode = Mode.DRAW) -> dict[str, Routing]:
        """Routing of all rows, or of at most `most` evenly spaced rows, by attribute. Empty for a
        scene without experts."""
        return {}

    def rows_by_level(self) -> list[int]:
        """Number of rows per level of detail, coarse to fine. Empty for a scene without levels."""
        return []

    def at_level(self, level: int | None) -> AbstractContextManager[None]:
        """Context manager that limits drawing to levels up to `level` (0 is the coarsest; None
        draws all levels).

        It has no effect on a scene without levels.
        """
        return nullcontext()

    def frozen(self, step: int) -> Draws:
        """Prepare the scene for faster drawing at `step` without gradients. The images do not
        change.

        Do not train the scene while the result is in use.
        """
        return self

    def as_photographed(self, image: Tensor, camera: Camera) -> Tensor:
        """Return a picture [H, W, 3] of the scene with the exposure of a camera's photograph; the
        picture itself where no exposures are learned. For comparisons with photographs."""
        return image if self.exposures is None else self.exposures.expose(image, camera)

    @property
    def rounding(self) -> RowRounding | None:
        """How values are rounded before they are drawn; None: they are drawn as they are."""
        return None

    def start_rounding(self, steps: Tensor, classes: Tensor, scale: float = 1.0) -> None:
        """Draw values from now on as a compact file would hold them. steps: of all values of a row;
        classes: [N] int64; scale: of the world. The default refuses: `SceneConfig.can_round`."""
        raise ValueError(f"expected a scene whose values can be rounded, found one of {self.traits.rows}")

    def forget_rounding(self) -> None:
        """Forget the steps that an earlier training has learned, before another one moves the
        values. The default does nothing."""

    def settled(self) -> Scene:
        """Return the scene that is evaluated and exported: what a training only imitates, such as
        rounded values, is done for good. The default is the scene itself."""
        return self

    def describe_decode(self, step: int) -> str:
        """Say which implementation decodes the scene at `step`, and why not the fastest. Empty for
        a scene with one."""
        return ""

    def direct(self, step: int, load: bool) -> DirectScene | str:
        """Return what draws training views at `step` without autograd, or why nothing does. It may
        be used until the rows change or the dense warm-up ends.

        load: whether the loss has the load-balancing term.
        """
        return "a scene without kernels"

    def end_batch(self, views: int) -> None:
        """Learn what no gradient teaches, once for a batch of `views` views, before the optimiser's
        step. The gradients of all views are added up by then, and divided by their number. The
        default does nothing."""

    def set_training_cameras(self, cameras: Sequence[Camera]) -> None:
        """Give the scene the cameras of its training views, before each training or its resumption.
        The default does nothing."""

    def begin_iteration(self, before: int, step: int, companions: Callable[[Tensor], list[Tensor]]) -> None:
        """Prepare for training iteration `step`, before its view is drawn. The default does
        nothing.

        Args:
            before: Step of the last iteration; 0 before the first.
            step: Step of this one: `before` and the number of views of a batch.
            companions: Returns the tensors that follow a network's parameter, of its shape: Adam's
                moments, its average.
        """


class LatticeScene(Scene):
    """A scene whose rows lie on a lattice. Densification adds rows at empty cells. The table has a
    fact `cell` [N, 3] int64."""

    voxel: float  # edge of the finest lattice cell, in trained world units

    @abstractmethod
    def new_rows(self, cells: Tensor, size: float, feature: Tensor, level: int = 0) -> dict[str, Tensor]:
        """Columns of new rows at the cells [n, 3] of `level`, with scaling `size` (trained world
        units) and features [n, F]."""

    @abstractmethod
    def slot_points(self, slots: Tensor, rows: Tensor) -> Tensor:
        """Positions [P, 3] float64 of the Gaussians at the flat `slots` [P] (row * K + slot) of
        `rows` [P]."""


@dataclass(frozen=True)
class SceneConfig(Part, ABC):
    """Settings of a scene. The fields are the recipe's flags under --scene."""

    family: ClassVar[str]
    """Key of the family, as in `Traits.family`."""

    @property
    @abstractmethod
    def grown_as(self) -> str:
        """Value of `Strategy.grows` that strategies for this scene must have, for example "anchors
        on levels"."""

    def needs_whole_table(self) -> str:
        """Return the setting that needs all rows in every process, for the message of --shard; ""
        if none does. The default refuses."""
        return f"a scene of {self.grown_as}"

    @property
    def dense_until(self) -> int:
        """Last iteration of the experts' dense warm-up. 0 if there is none."""
        return 0

    @property
    def can_round(self) -> bool:
        """Whether the scene has `Scene.start_rounding`, which --rate needs."""
        return False

    def phases(self) -> dict[str, int]:
        """Return the last iteration of each phase that a training leaves for good, by the dotted
        path of the field that sets it."""
        return {}

    @property
    def has(self) -> frozenset[str]:
        """What the scene has of OPACITY, ROUTERS, EXPERTS, CODES and EXPLICIT. Settings that need another
        have no effect; a training warns about them."""
        return frozenset()

    def of_views(self, views: int) -> Self:
        """Return the settings with which any number of training views is treated as `views` of
        them. The default depends on no number."""
        return self

    @abstractmethod
    def start(self, points: Points, extent: float, cameras: Sequence[Camera] = ()) -> Scene:
        """Create a scene from a point cloud and the cameras of the training views. Some families
        ignore the cameras."""

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shapes of a row in the columns that a checkpoint must have (`params.NAME`,
        `facts.NAME`). Empty: not checked."""
        return {}

    @abstractmethod
    def load(self, table: Table, meta: dict[str, Any]) -> Scene:
        """Build a scene from a checkpoint's table and `Scene.meta()`. `restore_scene` loads the
        tensors of its networks."""


def restore_scene(config: SceneConfig, tensors: dict[str, Tensor], meta: dict[str, Any], averaged: bool = False) -> Scene:
    """Build a scene from the tensors and the metadata of a checkpoint.

    Args:
        config: Settings of the scene, scaled to the length of the training.
        tensors: Columns `params.NAME` and `facts.NAME` of the table, and networks `network.NAME`.
            Other tensors are ignored.
        meta: The values of `Scene.meta()`. Other values are ignored.
        averaged: Use the averages of the weights (`average.params.NAME`, `average.network.NAME`),
            if there are any, in place of the last weights, and return the scene `settled`.

    Raises:
        InputError: The networks have other names or shapes than those of `config`.
    """
    pick = lambda prefix: {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}  # noqa: E731
    if averaged:
        tensors = tensors | pick("average.")
    with torch.random.fork_rng(devices=()):  # new networks draw their first weights; a training may be under way
        scene = config.load(Table(pick("params."), pick("facts.")), meta)
    stored, wanted = pick("network."), scene.network_tensors()
    if stored.keys() != wanted.keys() or any(stored[k].shape != wanted[k].shape for k in wanted):
        raise InputError("expected the networks of this recipe in the checkpoint, found others; evaluate it with its own run folder")
    with torch.no_grad():
        for name, parameter in wanted.items():
            parameter.copy_(stored[name])
    return scene.settled() if averaged else scene


@dataclass(frozen=True)
class LearningRates(Part, ABC):
    """Learning rates of a family: one `Rate` for each group of `Scene.rate_groups`. The flags are
    under --rates."""

    family: ClassVar[str]
    """Key of the family, as in `Traits.family`."""

    @abstractmethod
    def at(self, group: str, step: int, total: int, extent: float) -> float:
        """Learning rate of `group` at `step` of `total`. extent: the extent R of the scene, in
        trained world units."""
