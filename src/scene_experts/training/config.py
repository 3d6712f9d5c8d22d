"""Configuration of a training: one typed value with every setting that affects the results."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from scene_experts.arguments.option import Option
from scene_experts.core.errors import InputError
from scene_experts.core.fields import (
    SCALES,
    Count,
    CountOrNone,
    NotNegative,
    Range,
    Share,
    With,
    changed_without,
    check_fields,
    flag_of,
    scale,
)
from scene_experts.core.parts import Part, find
from scene_experts.data.settings import Data
from scene_experts.scene import EXPLICIT, LearningRates, SceneConfig
from scene_experts.scene.anchors.rates import Rates
from scene_experts.scene.anchors.scene import Anchors
from scene_experts.strategy import Strategy
from scene_experts.strategy.grow import GrowAnchors
from scene_experts.training.average import Average
from scene_experts.training.losses import Weights
from scene_experts.training.optim import Adam, Optimizer
from scene_experts.training.options import TrainOptions

SCHEDULE = 30_000  # default length of the schedule, iterations; recipes may override it
LARGEST_SEED = 2**63 - 2  # torch accepts signed 64-bit seeds, and densification uses seed + 1


@dataclass(frozen=True)
class Train:
    """A recipe and its numbers."""

    recipe: Annotated[str, Option(hidden=True)]
    """Name of the recipe."""
    scene: SceneConfig = Anchors()
    """What the scene is made of: anchors and their decoders, Gaussians, or graph points."""
    loss: Weights = Weights()
    """Weights of the loss terms."""
    growth: Strategy = GrowAnchors()
    """Densification: where rows are added and removed."""
    rates: LearningRates = Rates()
    """Learning rates."""
    optimizer: Optimizer = Adam()
    """The optimiser."""
    average: Average = Average()
    """An average of the weights, which is evaluated and exported in place of the last weights."""
    iterations: Count = SCHEDULE
    """Number of training iterations. `info` proposes one that takes minutes; the default is that of
    the papers. Another number rescales the whole schedule (learning rates, densification,
    warm-up)."""
    batch: Count = 1
    """Training views per optimiser step. Iterations count views, so N iterations make N / batch
    steps. Several processes (torchrun) share the views of a batch."""
    batch_rates: Annotated[Share, With(("batch",), off=1)] = 0.5
    """Learning rates are multiplied by batch to this power. 0.5 keeps the variance of what a view
    moves (Zhao et al. 2024), 1 keeps how far the views together move."""
    seed: Annotated[int, Range(0, LARGEST_SEED)] = 0
    """Seed of all random numbers."""
    antialias: bool = False
    """Compensate the opacity for the 0.3 px blur (2D filter of Mip-Splatting)."""
    random_background: bool = False
    """Train over a random background colour in each iteration, so that everything the photographs
    show becomes opaque. Transparent photographs keep the colour that they are composited over."""
    random_background_from: Annotated[int, Range(0), SCALES, With(("random_background",))] = 0
    """Iteration after which the background is random; until then it is that of the capture.
    --iterations rescales it."""
    half_until: Annotated[int, Range(0), SCALES] = 0
    """Until this iteration, see photographs of 800 px and more (the longest side) at half their size:
    fewer pixels are drawn, and growth needs no more. The training PSNR is that of what is seen.
    --iterations rescales it; 0: see them as they are."""
    dense_views: CountOrNone = 0
    """With at most this many training views, and fewer than 26,000 points, start from points that a
    plane sweep finds in them, unless --init or --points says where to start."""
    far_points: Annotated[float, Range(0, 1000)] = 0.0
    """Where the photographs show none of the capture's points, such as sky, start from points at this
    many times the farthest depth that they show, unless --init says where to start; nothing is
    added there later. 0: from none."""
    mean_background: bool = False
    """Put the mean colour of the training photographs behind what none of them shows, unless
    --background names a colour or the photographs are transparent or masked."""
    near_share: Annotated[float, Range(0, 1)] = 0.0
    """Draw nothing nearer than this share of the least depth that the training photographs show,
    unless --near says so: what lies there is fog. 0: --near has its default."""
    exposure: bool = False
    """Learn the exposure and white balance of each training photograph. The scene is that of their
    mean; `eval` draws a held-out view at the exposure of the photographs near it."""
    refine_poses: bool = False
    """Learn small motions of the training cameras with the scene, for poses that are not exact.
    `eval` first aligns each held-out camera with the trained scene."""
    max_anchors: CountOrNone = 0
    """Stop densification at this number of anchors; 0 leaves that of the growth rule (a million for
    3dgs-mcmc, otherwise none)."""
    sparse_adam: bool = False
    """Update only the rows that a view has decoded (SelectiveAdam of gsplat). Faster if views see a
    small part of the scene; changes the results."""
    rate: NotNegative = 0.0
    """Weight of the bits of a compact file in the loss, for recipes of anchors; 0.0005 saves a
    sixth to a third of the bytes and costs little, 0.002 half and some quality. It counts once
    growth has ended, and from half of the training on at the latest; 0: bits do not count."""
    schedule: Annotated[int, Option(hidden=True)] = SCHEDULE
    """The iterations that this recipe's windows are written for."""

    def scaled(self) -> Train:
        """Return a copy whose schedule is scaled by iterations / schedule. Raises InputError if
        `iterations` is below 1."""
        factor = self._factor()
        made = scale(self, factor)
        return replace(made, growth=replace(made.growth, max_anchors=self.max_anchors or self.growth.max_anchors))

    def scaled_scene(self) -> SceneConfig:
        """Return the scene's settings of `scaled()`: all that drawing a trained scene needs. Raises
        InputError as `scaled` does."""
        return self.scene.scaled(self._factor())

    def _factor(self) -> float:
        if self.iterations < 1:
            raise InputError(f"expected at least 1 iteration, found {self.iterations}; use --iterations 30000")
        if self.schedule < 1:
            raise InputError(f"expected a schedule of at least 1 iteration, found {self.schedule}; restore the configuration")
        return self.iterations / self.schedule


@dataclass(frozen=True)
class RunConfig:
    """Contents of a run folder's config.json: everything needed to evaluate, resume and repeat the
    run."""

    train: Train
    data: Data
    command: str = ""
    deterministic: bool = False
    stop_at: int | None = None
    versions: dict[str, str] = field(default_factory=dict)
    max_memory: float = 0.0  # GiB at which growth stops, so the results may depend on the machine; 0: no limit
    init_from: Path | None = None  # run folder whose scene the training started from; None: the points of the capture

    @classmethod
    def of(
        cls, train: Train, data: Data, options: TrainOptions, command: str, versions: dict[str, str], init_from: Path | None = None
    ) -> RunConfig:
        """The configuration of a training with `options`."""
        return cls(train, data, command, options.deterministic, options.stop_at, versions, options.max_memory, init_from)


def check(cfg: Train) -> None:
    """Check the settings. Raises InputError, which names the flag, if a setting is invalid."""
    check_fields(cfg)
    if cfg.iterations % cfg.batch:
        nearest = max(1, round(cfg.iterations / cfg.batch)) * cfg.batch
        raise InputError(f"expected --iterations that --batch {cfg.batch} divides, found {cfg.iterations}; give for example {nearest}")
    if unknown := unregistered(cfg):
        raise InputError(f"expected registered parts in the recipe, found {unknown[0]}; decorate its class with @register")
    if cfg.growth.grows != cfg.scene.grown_as:
        raise InputError(
            f"expected a growth rule for {cfg.scene.grown_as}, found one for {cfg.growth.grows}; use a recipe whose scene and growth fit"
        )
    if cfg.rates.family != cfg.scene.family:
        raise InputError(f"expected learning rates for {cfg.scene.family}, found those for {cfg.rates.family}; use a recipe where they fit")
    if cfg.rate and not cfg.scene.can_round:
        raise InputError(
            f"expected a recipe of anchors for --rate, found one of {cfg.scene.grown_as}; choose one of those, or leave it out"
        )
    if cfg.sparse_adam and not cfg.optimizer.by_row:
        raise InputError("expected an optimiser that can move some rows only for --sparse-adam, found another; leave the flag out")


def find_unused(cfg: Train, usual: Train | None = None) -> list[str]:
    """Return the flags of the settings that have no effect on the scene of `cfg` and have neither the
    default of their part nor the value in `usual`, the settings of the recipe. Both are those before
    scaling."""
    places = list(changed_without(cfg, cfg.scene.has, usual))
    if cfg.sparse_adam and cfg.loss.regularises and EXPLICIT in cfg.scene.has:
        places.append("sparse_adam")  # these losses move every row
    return [flag_of(place) for place in places]


def unregistered(value: Any) -> list[str]:
    """Return the class names of the parts of `value` that are not registered. A run with such a
    part cannot be opened again."""
    if not dataclasses.is_dataclass(value):
        return []
    below = [name for f in dataclasses.fields(value) for name in unregistered(getattr(value, f.name))]
    kind = type(value)
    return [kind.__name__, *below] if isinstance(value, Part) and find(kind.__name__, Part) is not kind else below


def with_numbers(cfg: Train, numbers: Sequence[tuple[str, Any]]) -> Train:
    """Return a copy of `cfg` with new values at dotted paths, for example ("scene.voxel_size",
    0.001). Ignores unknown paths."""
    for place, value in numbers:
        if _has(cfg, place):
            cfg = _put(cfg, place.split("."), value)
    return cfg


def flags_of(cfg: Train, numbers: Sequence[tuple[str, Any]]) -> list[str]:
    """Return the command-line arguments of `train` for the same values. Ignores unknown paths."""
    found = [(place, value) for place, value in numbers if _has(cfg, place)]
    return [word for place, value in found for word in (flag_of(place), str(value))]


def _has(value: Any, place: str) -> bool:
    first, _, rest = place.partition(".")
    known = dataclasses.is_dataclass(value) and first in {f.name for f in dataclasses.fields(value)}
    return known and (not rest or _has(getattr(value, first), rest))


def _put(part: Any, place: list[str], value: Any) -> Any:
    return replace(part, **{place[0]: value if len(place) == 1 else _put(getattr(part, place[0]), place[1:], value)})
