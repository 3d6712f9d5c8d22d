"""The runs that an experiment needs, each with every setting that changes its numbers, and the size
of a smaller experiment."""

from __future__ import annotations

import ast
import dataclasses
import hashlib
import json
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import Any

from scene_experts.core.errors import InputError
from scene_experts.core.fields import flag_of
from scene_experts.core.plain import from_json, lean, to_json
from scene_experts.data import capture as captures_
from scene_experts.data.fetch import catalog
from scene_experts.data.fetch.obtain import is_present
from scene_experts.data.images import check_policy
from scene_experts.data.readers import is_capture, unrecognised_error
from scene_experts.data.settings import Data
from scene_experts.reproduce.experiments import Experiment
from scene_experts.reproduce.variants import base, flags, read_line
from scene_experts.training.config import Train, flags_of

COLLECTIONS = {"mipnerf360": "MipNeRF360", "tandt": "TanksAndTemples", "db": "DeepBlending", "bungeenerf": "BungeeNeRF"}
OWN = "captures"  # the data set of the user's own captures


@dataclass(frozen=True)
class CaptureSpec:
    """A capture to train on. Its protocol sets `options` of Data (resolution, split, normalise,
    ...) and `numbers` of Train."""

    name: str
    dataset: str
    path: Path
    options: dict[str, Any] = field(default_factory=dict, hash=False)
    numbers: catalog.Numbers = ()


@dataclass(frozen=True)
class Scale:
    """The size of an experiment."""

    share: float = 1.0
    """Share of each recipe's schedule, in (0, 1]."""
    iterations: int | None = None
    """Iterations of every recipe; replaces the share."""
    resolution: str | None = None
    """Resolution policy; None: that of the scene's protocol."""

    @classmethod
    def of(cls, scale: float, iterations: int | None = None, resolution: str | None = None) -> Scale:
        """Make a scale. `scale` in (0, 1] shortens the schedule and the pictures' sides; the other
        two override it. Raises InputError."""
        if not 0 < scale <= 1:
            raise InputError(f"expected --scale above 0 and at most 1, found {scale}; 1 is the paper's size")
        if iterations is not None and iterations < 1:
            raise InputError(f"expected --iterations of at least 1, found {iterations}; give a larger number or leave it out")
        return cls(scale, iterations, check_policy(resolution) if resolution and resolution != "auto" else resolution)

    def length(self, cfg: Train) -> int:
        """Return the iterations of a recipe. The full schedule of Octree-GS has 40,000, that of the
        others 30,000."""
        return self.iterations or max(1, round(cfg.schedule * self.share))


def shrink(policy: str, share: float) -> str:
    """Return the policy whose pictures have `share` of the side lengths of `policy`. inria:N
    becomes factor:M of the full photographs."""
    kind, _, number = policy.partition(":")
    if kind in ("inria", "factor", "as-is"):
        return f"factor:{float(number or 1) / share:g}"
    if kind == "longest":
        return f"longest:{max(16, round(int(number) * share))}"
    return f"share:{(float(number) if kind == 'share' else 1.0) * share:g}"


@dataclass(frozen=True)
class Spec:
    """One run: a recipe on a scene with a seed. The recipe may have flags: "moe-gs --scene.hidden
    8"."""

    scene: CaptureSpec
    recipe: str
    seed: int
    scale: Scale

    @property
    def train(self) -> Train:
        cfg = read_line(self.recipe, self.scene.numbers)
        return replace(cfg, iterations=self.scale.length(cfg), seed=self.seed)

    @property
    def data(self) -> Data:
        options = dict(self.scene.options)
        if self.scale.resolution:
            options["resolution"] = self.scale.resolution
        elif self.scale.share < 1:
            options["resolution"] = shrink(options.get("resolution", "auto"), self.scale.share)
        return Data(path=self.scene.path, **options)

    @property
    def key(self) -> str:
        """A short hash of every setting that changes the run's numbers. The path of the capture is
        left out."""
        return identity(self.scene.name, self.train, self.data, self.code)

    @property
    def numbers(self) -> str:
        """The same hash without the recipe's name. Rows of different experiments with the same hash
        are the same training."""
        return identity(self.scene.name, replace(self.train, recipe=""), self.data, self.code)

    @cached_property
    def code(self) -> str:
        """As `code_of` its recipe."""
        return code_of(self.train)

    @property
    def label(self) -> str:
        fold = f", {split.replace(':', ' ')}" if (split := self.data.split).startswith("fold:") else ""
        return f"{self.recipe} on {self.scene.name}, seed {self.seed}{fold}"

    def folder(self, root: Path) -> Path:
        """Return the path of the run folder. No two configurations share one."""
        return root / self.scene.name / base(self.recipe) / f"seed{self.seed}-{self.key}"

    def arguments(self, out: Path) -> list[str]:
        """Return the arguments of `scene-experts` that train the run."""
        read = {name: value for name, value in vars(self.data).items() if value != getattr(Data(path=self.scene.path), name)}
        set_here = {"data": self.scene.path, "out": out, "iterations": self.train.iterations, "seed": self.seed, "preview_every": 0, **read}
        args = ["train", base(self.recipe), *(word for name, value in set_here.items() for word in (flag_of(name), str(value)))]
        own = flags(self.recipe)
        given = {word.partition("=")[0] for word in own}
        return args + flags_of(self.train, [(place, value) for place, value in self.scene.numbers if flag_of(place) not in given]) + own


def identity(scene: str, train: Train, data: Data, code: str = "", start: Path | None = None) -> str:
    """Return the hash that names a run: of the scene's name, what differs from the defaults of the
    recipe's parts (`lean`) and of how the capture is read (not its path), the code of other
    packages (`code_of`), and the name of the run whose scene it started from. A background
    and a near plane that the recipe computes (`mean_background`, `near_share`) follow from the
    rest."""
    more = [code] if code else []
    more += [f"from {start.name}"] if start else []
    as_read = from_json(Train, to_json(train))  # 2 in place of 2.0 is the same setting
    stated = replace(data, background=None) if train.mean_background else data
    stated = replace(stated, near=None) if train.near_share else stated
    text = json.dumps([scene, lean(as_read), stated.settings(), *more], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def code_of(train: Train) -> str:
    """Return a hash of the source files of the packages, other than this one, that a recipe has
    parts of; "" without such parts. To a module that is a single file belong those beside it that it
    imports.

    A run is therefore trained again after a change of the code that it was trained with.
    """
    ours = __name__.partition(".")[0]
    names = {type(part).__module__.partition(".")[0] for part in parts_of(train)} - {ours}
    found = hashlib.sha256()
    for name in sorted(names):
        module = sys.modules[name]
        files = [file for place in getattr(module, "__path__", ()) for file in files_below(Path(place))]
        if not files and getattr(module, "__file__", None):
            files = files_of(Path(str(module.__file__)))
        for label, path in sorted(files):
            found.update(f"{name} {label} ".encode() + hashlib.sha256(path.read_bytes()).digest())
    return found.hexdigest()[:12] if names else ""


def files_below(folder: Path) -> list[tuple[str, Path]]:
    """Return the source files of a package, each with its place in it."""
    return [(path.relative_to(folder).as_posix(), path) for path in folder.rglob("*.py")]


def files_of(file: Path) -> list[tuple[str, Path]]:
    """Return a source file, and those in its folder that it imports, also by way of others, each with
    its name: modules and packages, but none of another distribution that is installed there."""
    owners, found, left = packages_distributions(), dict[str, Path](), [file]
    others = {name for name, of in owners.items() if not set(of) & set(owners.get(file.stem, ()))} | {__name__.partition(".")[0]}
    while left:
        path = left.pop()
        if path.stem in found:
            continue
        found[path.stem] = path
        for name in imports_of(path) - others:
            if (beside := file.with_name(f"{name}.py")).is_file():
                left.append(beside)
            elif (file.parent / name / "__init__.py").is_file():
                found |= {f"{name}/{label}": below for label, below in files_below(file.parent / name)}
    return list(found.items())


def imports_of(file: Path) -> set[str]:
    """Return the names of the modules and packages that a source file imports; none of a file that
    Python cannot read."""
    found: set[str] = set()
    with suppress(SyntaxError, ValueError):
        for node in ast.walk(ast.parse(file.read_bytes())):
            if isinstance(node, ast.Import):
                found |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                found.add(node.module.partition(".")[0])
    return found


def parts_of(value: Any) -> Iterator[Any]:
    """Yield a recipe and all its parts: the dataclasses that it is made of."""
    if dataclasses.is_dataclass(value):
        yield value
        for f in dataclasses.fields(value):
            yield from parts_of(getattr(value, f.name))
    elif isinstance(value, (tuple, list)):
        for entry in value:
            yield from parts_of(entry)


def find_own_scenes(captures: Sequence[Path]) -> list[CaptureSpec]:
    """Return the user's captures as scenes of one data set. Raises InputError where a folder is
    missing or two have the same name."""
    scenes = [CaptureSpec(captures_.name_capture(path), OWN, path) for path in captures]
    for scene in scenes:
        if not scene.path.is_dir():
            raise InputError(f"expected a capture folder at {scene.path}, found none; correct --captures")
        if len(same := [str(other.path.resolve()) for other in scenes if other.name == scene.name]) > 1:
            found = f"found several called '{scene.name}': {', '.join(same)}"
            raise InputError(f"expected captures with different names, {found}; rename one of these folders")
    return [replace(scene, options=held_out(scene.path)) for scene in scenes]


def held_out(path: Path) -> dict[str, Any]:
    """Return the options of a capture's reading: those that hold views out for the scores where few
    photographs would all be trained on."""
    if not is_capture(path):
        return {}  # `check_folders` says so
    with suppress(InputError):  # the runs say what is wrong
        capture = captures_.load(Data(path), allow_no_points=True)
        capture.images.close()
        return {"split": "mod8"} if capture.split == "none" else {}
    return {}


def check_folders(scenes: Sequence[CaptureSpec]) -> None:
    """Raise InputError for a scene whose folder is not a capture: all its runs would fail."""
    for scene in scenes:
        if not is_capture(scene.path):
            raise unrecognised_error(scene.path)


def find_paper_scenes(root: Path) -> list[CaptureSpec]:
    """Find the paper's scenes below `root`, each with the paper's protocol. As in the paper's code,
    they keep their own units."""
    found = []
    for scene in catalog.SCENES:
        if is_present(root, scene):
            options = {"resolution": scene.resolution, "split": scene.split, "normalise": "none"}
            found.append(CaptureSpec(scene.name, COLLECTIONS[scene.collection.key], root / scene.path, options, scene.collection.numbers))
    return found


def list_runs(experiments: Iterable[Experiment], scenes: Sequence[CaptureSpec], seeds: Sequence[int], scale: Scale) -> list[Spec]:
    """List the runs that experiments need, each once. All runs of a seed come before the next seed,
    so a table is complete early.

    The user's own captures are used in place of every data set. The paper's scenes are used in the
    experiments that name them.
    """
    wanted: dict[Spec, None] = {}
    for seed in seeds:
        for experiment in experiments:
            for scene in scenes:
                if scene.dataset != OWN and not experiment.shows(scene.dataset, scene.name):
                    continue
                for recipe in experiment.rows.values():
                    wanted[Spec(scene, recipe, seed, scale)] = None
    return list(wanted)


def drop_repeated(wanted: Iterable[Spec]) -> list[Spec]:
    """Keep the first of the runs with the same numbers, in order."""
    first: dict[str, Spec] = {}
    for spec in wanted:
        first.setdefault(spec.numbers, spec)
    return list(first.values())
