"""Which runs an experiment needs, each with everything that changes its numbers, and how short a smaller experiment is."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from scene_experts.core.errors import InputError
from scene_experts.data.fetch import catalog
from scene_experts.data.fetch.obtain import is_present
from scene_experts.data.images import check_policy
from scene_experts.data.readers import is_capture, unrecognised_error
from scene_experts.recipes import RECIPES
from scene_experts.reproduce.experiments import Experiment
from scene_experts.training.config import Data, Train, flags_of, to_json, with_numbers

COLLECTIONS = {"mipnerf360": "MipNeRF360", "tandt": "TanksAndTemples", "db": "DeepBlending", "bungeenerf": "BungeeNeRF"}
OWN = "captures"  # the name of the user's own captures among the data sets


@dataclass(frozen=True)
class Scene:
    """A capture to train on. `options`: what its protocol sets in Data (resolution, split, normalise, ...); `numbers`: in Train."""

    name: str
    dataset: str
    path: Path
    options: dict[str, Any] = field(default_factory=dict, hash=False)
    numbers: catalog.Numbers = ()


@dataclass(frozen=True)
class Scale:
    """How large an experiment is: the share of each recipe's schedule, or iterations, and the picture's size (None: the protocol's)."""

    share: float = 1.0
    iterations: int | None = None  # in place of the share, the same for all recipes
    resolution: str | None = None

    @classmethod
    def of(cls, scale: float, iterations: int | None = None, resolution: str | None = None) -> Scale:
        """`scale` in (0, 1] shortens the schedule and the pictures' sides together; the other two override it. Raises InputError."""
        if not 0 < scale <= 1:
            raise InputError(f"expected --scale above 0 and at most 1, found {scale}; 1 is the paper's own size")
        if iterations is not None and iterations < 1:
            raise InputError(f"expected --iterations of at least 1, found {iterations}; give a larger number or leave it out")
        return cls(scale, iterations, check_policy(resolution) if resolution and resolution != "auto" else resolution)

    def length(self, cfg: Train) -> int:
        """Iterations of a recipe: Octree-GS is written for 40,000, the others for 30,000."""
        return self.iterations or max(1, round(cfg.schedule * self.share))


def smaller(policy: str, share: float) -> str:
    """The resolution policy that gives `share` of the sides that `policy` gives; what inria:N reads is made of the full photographs."""
    kind, _, number = policy.partition(":")
    if kind in ("inria", "factor", "as-is"):
        return f"factor:{float(number or 1) / share:g}"
    if kind == "longest":
        return f"longest:{max(16, round(int(number) * share))}"
    return f"share:{(float(number) if kind == 'share' else 1.0) * share:g}"


@dataclass(frozen=True)
class Spec:
    """One run: a recipe on a scene with a seed."""

    scene: Scene
    recipe: str
    seed: int
    scale: Scale

    @property
    def train(self) -> Train:
        cfg = with_numbers(RECIPES[self.recipe][1], self.scene.numbers)
        return replace(cfg, iterations=self.scale.length(cfg), seed=self.seed)

    @property
    def data(self) -> Data:
        options = dict(self.scene.options)
        if self.scale.resolution:
            options["resolution"] = self.scale.resolution
        elif self.scale.share < 1:
            options["resolution"] = smaller(options.get("resolution", "auto"), self.scale.share)
        return Data(path=self.scene.path, **options)

    @property
    def key(self) -> str:
        """A short hash of everything that changes the run's numbers but the place of the capture."""
        return identity(self.scene.name, self.train, self.data)

    @property
    def numbers(self) -> str:
        """The same hash without the recipe's name: some rows of different experiments are one and the same training."""
        return identity(self.scene.name, replace(self.train, recipe=""), self.data)

    @property
    def label(self) -> str:
        return f"{self.recipe} on {self.scene.name}, seed {self.seed}"

    def folder(self, root: Path) -> Path:
        """Where its run folder is: readable, and never that of another configuration."""
        return root / self.scene.name / self.recipe / f"seed{self.seed}-{self.key}"

    def arguments(self, out: Path) -> list[str]:
        """The arguments of `scene-experts train` that make it."""
        args = ["train", self.recipe, "--data", str(self.scene.path), "--out", str(out)]
        args += ["--iterations", str(self.train.iterations), "--seed", str(self.seed), "--preview-every", "0"]
        args += flags_of(self.train, self.scene.numbers)
        for name, value in vars(self.data).items():
            if name != "path" and value != getattr(Data(path=self.scene.path), name):
                args += [f"--{name.replace('_', '-')}", str(value)]
        return args


def identity(scene: str, train: Train, data: Data) -> str:
    """The hash that names a run: scene, recipe with all numbers, how the capture is read; not where it lies."""
    text = json.dumps([scene, to_json(train), data.settings()], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def own_scenes(captures: Sequence[Path]) -> list[Scene]:
    """The user's captures as scenes of one data set. Raises InputError where two have one name or one is not there."""
    scenes = [Scene(path.resolve().name, OWN, path) for path in captures]
    for scene in scenes:
        if not scene.path.is_dir():
            raise InputError(f"expected a capture folder at {scene.path}, found none; correct --captures")
        if sum(other.name == scene.name for other in scenes) > 1:
            raise InputError(f"expected captures of different names, found several called '{scene.name}'; rename or link one of them")
    return scenes


def expect_captures(scenes: Sequence[Scene]) -> None:
    """Raises InputError for a scene whose folder is no capture: all of its runs would fail."""
    for scene in scenes:
        if not is_capture(scene.path):
            raise unrecognised_error(scene.path)


def paper_scenes(root: Path) -> list[Scene]:
    """The paper's scenes that lie below `root`, each with the paper's protocol; trained in their own units, as the paper's code does."""
    found = []
    for scene in catalog.SCENES:
        if is_present(root, scene):
            options = {"resolution": scene.resolution, "split": scene.split, "normalise": "none"}
            found.append(Scene(scene.name, COLLECTIONS[scene.collection.key], root / scene.path, options, scene.collection.numbers))
    return found


def specs(experiments: Iterable[Experiment], scenes: Sequence[Scene], seeds: Sequence[int], scale: Scale) -> list[Spec]:
    """The runs that experiments need, each once: seed by seed, so that a whole first table stands early.

    A user's own captures stand for every data set; the paper's scenes serve the experiments that name them.
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


def distinct(wanted: Iterable[Spec]) -> list[Spec]:
    """The first of all runs that have the same numbers, in order."""
    first: dict[str, Spec] = {}
    for spec in wanted:
        first.setdefault(spec.numbers, spec)
    return list(first.values())
