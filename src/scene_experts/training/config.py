"""A training as one typed value: everything that changes its numbers, to and from plain JSON."""

from __future__ import annotations

import dataclasses
import types as pytypes
import typing
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from scene_experts.arguments.option import Option
from scene_experts.core.errors import InputError, expect_at_least
from scene_experts.core.schedule import Rate
from scene_experts.data.settings import Data as Data
from scene_experts.scene.anchors.scene import Anchors, Rates
from scene_experts.scene.anchors.select import Octree
from scene_experts.scene.gaussians import Explicit, ExplicitRates
from scene_experts.scene.graph.scene import GraphPoints, GraphRates
from scene_experts.strategy.grow import GrowAnchors
from scene_experts.strategy.grow_octree import GrowOctree
from scene_experts.strategy.grow_points import GrowPoints
from scene_experts.strategy.mcmc import MCMC
from scene_experts.strategy.split_clone import SplitClone
from scene_experts.training.losses import Weights

SCHEDULE = 30_000  # the iterations that schedule constants are written for, unless a recipe says otherwise
LARGEST_SEED = 2**63 - 2  # torch takes signed 64 bits, and growth draws from the seed after this one


@dataclass(frozen=True)
class Train:
    """A recipe with its numbers."""

    recipe: Annotated[str, Option(hidden=True)]
    """Name of the recipe."""
    scene: Anchors | Explicit | GraphPoints = Anchors()
    """What the scene is made of: anchors and their decoders, Gaussians, or graph points."""
    loss: Weights = Weights()
    """Weights of the loss terms."""
    growth: GrowAnchors | GrowOctree | GrowPoints | SplitClone | MCMC = GrowAnchors()
    """Densification: where rows are added and removed."""
    rates: Rates | ExplicitRates | GraphRates = Rates()
    """Learning rates."""
    iterations: int = SCHEDULE
    """Length of the training. Another length rescales the whole schedule (learning rates, densification windows, warm-up)."""
    seed: int = 0
    """Seed of all random numbers, at least 0."""
    antialias: bool = False
    """Compensate opacity for the 0.3 px blur (Mip-Splatting's 2D filter)."""
    random_background: bool = False
    """Another background colour every iteration."""
    max_anchors: int = 0
    """Stop growing at this many anchors; 0 is no cap."""
    sparse_adam: bool = False
    """Move only what a view decoded (gsplat's SelectiveAdam): faster where views see a small part; changes results."""
    schedule: Annotated[int, Option(hidden=True)] = SCHEDULE
    """The iterations that this recipe's windows are written for."""

    def scaled(self) -> Train:
        """The same with every window of the schedule in iterations of this training (x iterations / schedule)."""
        if self.iterations < 1:
            raise InputError(f"expected at least 1 iteration, found {self.iterations}; use --iterations 30000")
        factor = self.iterations / self.schedule
        until = self.loss.opacity_until
        loss = replace(
            self.loss,
            opacity_from=round(self.loss.opacity_from * factor),
            opacity_until=None if until is None else round(until * factor),
        )
        growth = replace(self.growth.scaled(factor), max_anchors=self.max_anchors or self.growth.max_anchors)
        return replace(self, scene=self.scene.scaled(factor), loss=loss, growth=growth)


@dataclass(frozen=True)
class RunConfig:
    """What a run folder's config.json says: enough to evaluate, resume and repeat the run."""

    train: Train
    data: Data
    command: str = ""
    deterministic: bool = False
    stop_at: int | None = None
    versions: dict[str, str] = field(default_factory=dict)


def check(cfg: Train) -> None:
    """Raises InputError, naming the flag, for settings that no training can have."""
    expect_at_least([("--iterations", cfg.iterations, 1), ("--seed", cfg.seed, 0), ("--max-anchors", cfg.max_anchors, 0)])
    if cfg.seed > LARGEST_SEED:
        raise InputError(f"expected --seed of at most {LARGEST_SEED}, found {cfg.seed}; give a smaller number")
    cfg.scene.check()
    cfg.loss.check()
    cfg.growth.check()
    levels, grown = isinstance(getattr(cfg.scene, "select", None), Octree), isinstance(cfg.growth, GrowOctree)
    if levels != grown:
        raise InputError(
            f"expected anchors on levels and growth by level together, found {type(cfg.growth).__name__} on a scene "
            f"{'with' if levels else 'without'} levels; use the octree recipes"
        )
    graph = [isinstance(part, kind) for part, kind in ((cfg.scene, GraphPoints), (cfg.growth, GrowPoints), (cfg.rates, GraphRates))]
    if any(graph) and not all(graph):
        raise InputError("expected a scene, growth and rates of graph points together, found some of another method; use the recipe sags")
    for name, rate in vars(cfg.rates).items():
        if isinstance(rate, Rate) and not (rate.first > 0 < rate.last or rate.first == rate.last == 0):
            flag = f"--rates.{name.replace('_', '-')}"
            raise InputError(f"expected {flag} to run between two rates above 0, or to be 0 throughout, found {rate.first} and {rate.last}")


def with_numbers(cfg: Train, numbers: Sequence[tuple[str, Any]]) -> Train:
    """`cfg` with values at dotted places, as ("scene.voxel_size", 0.001); places that this recipe does not have are passed over."""
    for place, value in numbers:
        if _has(cfg, place):
            cfg = _put(cfg, place.split("."), value)
    return cfg


def flags_of(cfg: Train, numbers: Sequence[tuple[str, Any]]) -> list[str]:
    """The arguments of `train` that say the same."""
    found = [(place, value) for place, value in numbers if _has(cfg, place)]
    return [word for place, value in found for word in (flag(place), str(value))]


def flag(place: str) -> str:
    """The flag of a dotted place, as --scene.voxel-size."""
    return f"--{place.replace('_', '-')}"


def _has(value: Any, place: str) -> bool:
    first, _, rest = place.partition(".")
    known = dataclasses.is_dataclass(value) and first in {f.name for f in dataclasses.fields(value)}
    return known and (not rest or _has(getattr(value, first), rest))


def _put(part: Any, place: list[str], value: Any) -> Any:
    return replace(part, **{place[0]: value if len(place) == 1 else _put(getattr(part, place[0]), place[1:], value)})


def to_json(value: Any) -> Any:
    """Plain JSON of a dataclass tree. Values of union type carry their class name under "type"."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        out = {f.name: to_json(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return {"type": type(value).__name__, **out}
    if isinstance(value, dict):
        return {str(k): to_json(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_json(v) for v in value]
    return str(value) if isinstance(value, Path) else value


def from_json(kind: Any, value: Any, where: str = "config") -> Any:
    """The value of type `kind` that `to_json` wrote. Raises InputError naming the place that does not fit."""
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, pytypes.UnionType):
        return _from_union(args, value, where)
    if dataclasses.is_dataclass(kind):
        return _from_object(kind, value, where)
    if origin is Literal:
        if value not in args:
            raise InputError(f"expected one of {list(args)} at {where}, found {value!r}; correct the file")
        return value
    if origin is tuple:
        _expect(isinstance(value, list), "a list", where, value)
        inner = [args[0]] * len(value) if len(args) == 2 and args[1] is Ellipsis else list(args)
        _expect(len(inner) == len(value), f"{len(inner)} values", where, value)
        return tuple(from_json(k, v, f"{where}[{i}]") for i, (k, v) in enumerate(zip(inner, value)))
    if origin is dict:
        _expect(isinstance(value, dict), "an object", where, value)
        return {k: from_json(args[1], v, f"{where}.{k}") for k, v in value.items()}
    if kind is Path:
        _expect(isinstance(value, str), "a path", where, value)
        return Path(value)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    _expect(isinstance(value, kind) and not (kind is int and isinstance(value, bool)), f"a {kind.__name__}", where, value)
    return value


def _from_union(args: tuple[Any, ...], value: Any, where: str) -> Any:
    if value is None and type(None) in args:
        return None
    options = [a for a in args if a is not type(None)]
    all_options = [kind for a in options for kind in (a, *_variants(a))]
    if isinstance(value, dict) and "type" in value:
        for option in all_options:
            if getattr(option, "__name__", None) == value["type"]:
                return from_json(option, value, where)
    if len(options) == 1:
        return from_json(options[0], value, where)
    found = value["type"] if isinstance(value, dict) and "type" in value else value
    raise InputError(
        f"expected one of {[getattr(o, '__name__', str(o)) for o in all_options]} at {where}, found {found!r}; correct the file"
    )


def _variants(kind: Any) -> list[type]:
    """The parts made of a part by subclassing; a field that accepts it accepts them."""
    below = kind.__subclasses__() if isinstance(kind, type) else []
    return [variant for each in below for variant in (each, *_variants(each))]


def _from_object(kind: Any, value: Any, where: str) -> Any:
    _expect(isinstance(value, dict), "an object", where, value)
    hints = typing.get_type_hints(kind)  # annotations for the command line are left out
    known = {f.name for f in dataclasses.fields(kind)}
    unknown = set(value) - known - {"type"}
    _expect(not unknown, f"only the keys {sorted(known)}", where, sorted(unknown))
    needed = [f.name for f in dataclasses.fields(kind) if f.default is f.default_factory is dataclasses.MISSING]
    _expect(not set(needed) - set(value), f"the keys {needed}", where, sorted(set(value) - {"type"}))
    return kind(**{name: from_json(hints[name], item, f"{where}.{name}") for name, item in value.items() if name in known})


def _expect(fits: bool, what: str, where: str, found: Any) -> None:
    if not fits:
        raise InputError(f"expected {what} at {where}, found {found!r}; correct the file or start a new run")
