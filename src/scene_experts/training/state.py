"""The state of a training. It is saved to checkpoints and restored from them."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from scene_experts.core import checkpoint
from scene_experts.core.errors import InputError, few
from scene_experts.core.plain import MOST_DIFFERENCES, differences, from_json, to_json
from scene_experts.core.reading.budget import RUN
from scene_experts.core.reading.source import guarding
from scene_experts.data.capture import Capture
from scene_experts.scene import Scene, exposure, poses, restore_scene
from scene_experts.scene.exposure import Exposures
from scene_experts.scene.fit import restore_foreign
from scene_experts.scene.poses import Poses
from scene_experts.strategy import Strategy
from scene_experts.training.average import Averages
from scene_experts.training.clock import Clock
from scene_experts.training.config import Train
from scene_experts.training.direct import DirectStep
from scene_experts.training.guard import check_state
from scene_experts.training.memory import Largest
from scene_experts.training.rate import MODEL, RateTerm
from scene_experts.training.resident import Resident
from scene_experts.training.restoring import restore_moments, restore_stats

log: logging.Logger = logging.getLogger(__name__)


class Training:
    """The state of a training: scene, optimiser, averages, random number generators, queue of views
    and clock."""

    cfg: Train
    scene: Scene
    largest: Largest
    clock: Clock
    views_rng: torch.Generator
    growth_rng: torch.Generator
    optimizer: torch.optim.Optimizer

    def __init__(self, cfg: Train, scene: Scene) -> None:
        self.cfg, self.scene = cfg, scene
        self.step = 0
        self.largest = Largest()
        self.resident: Resident | None = None  # made by the loop, as `direct`
        self.direct: DirectStep | None = None
        self.clock = Clock()
        self.queue: list[int] = []
        self.computed = ""  # of the points that the scene has just started from; for `Started.start`
        self.capture_id = self.poses = ""  # fingerprint and poses of the capture
        self.chosen: str | None = None  # `Capture.chosen`; None: not known
        self.box: tuple[float, ...] = ()  # in which rows are created, beside what `cfg.growth` says; empty: everywhere
        self.views_rng = torch.Generator().manual_seed(cfg.seed)  # for the order of views and for backgrounds
        self.growth_rng = torch.Generator().manual_seed(cfg.seed + 1)  # for densification
        columns = scene.table.params
        named = scene.rate_groups().items()
        groups = [{"params": params, "name": name, "lr": 0.0, "by_row": name in columns} for name, params in named]
        self.optimizer = cfg.optimizer.for_batch(cfg.batch).build(groups)
        scene.table.attach(self.optimizer)
        self.averages = Averages(scene) if cfg.average.span > 0 else None
        if scene.exposures is not None:
            self.add_groups({exposure.GROUP: [scene.exposures.stops]})
        if scene.poses is not None and cfg.refine_poses:
            self.add_groups({poses.GROUP: [scene.poses.motions]})
        elif scene.poses is not None:
            scene.poses.requires_grad_(False)  # those of --init-from
        self.rate = RateTerm(cfg.rate, cfg.seed, cfg.growth, cfg.iterations) if cfg.rate else None

    @classmethod
    def start(cls, cfg: Train, capture: Capture, device: str, dtype: torch.dtype = torch.float32) -> Training:
        """Create a new training of `cfg`, which must be scaled, on a capture.

        Raises InputError if the capture has no points or no training views, or if the scene starts
        with more than `max_anchors` rows.
        """
        if capture.points is None:
            raise InputError("expected 3D points in the capture, found none; use --init random, or run structure from motion again")
        if not capture.train:
            raise InputError("expected at least one training view, found none; choose another --split")
        torch.manual_seed(cfg.seed)
        scene = cfg.scene.start(capture.points, capture.extent, [capture.views[i].camera for i in capture.train])
        cap, n = cfg.max_anchors, len(scene.table)
        if 0 < cap < n:
            traits = scene.traits
            also = " or --scene.voxel-size" if traits.voxel else ""
            raise InputError(f"expected at most {cap:,} {traits.rows} to start with, found {n:,}; raise --max-anchors{also}")
        if 0 < cfg.growth.max_anchors < n:
            log.warning("starts with %s rows, more than the recipe's %s: none will be added", f"{n:,}", f"{cfg.growth.max_anchors:,}")
        scene.exposures, scene.poses = new_exposures(cfg, capture), new_poses(cfg, capture)
        return cls(cfg, scene.to(device, dtype))

    def next_view(self, train: tuple[int, ...], ahead: int = 3) -> tuple[int, list[int]]:
        """Return the next training view and the `ahead` views after it. Each epoch uses every view
        once, in random order."""
        while len(self.queue) < ahead + 1:
            self.queue += [train[i] for i in torch.randperm(len(train), generator=self.views_rng).tolist()]
        return self.queue.pop(0), self.queue[:ahead]

    def next_batch(self, train: tuple[int, ...]) -> list[tuple[int, Tensor | None]]:
        """Return the next `cfg.batch` training views, each with its random background [3], or None
        while backgrounds are not random."""
        at_random = self.cfg.random_background and self.step > self.cfg.random_background_from
        batch: list[tuple[int, Tensor | None]] = []
        for _ in range(self.cfg.batch):
            index, _ = self.next_view(train)
            batch.append((index, torch.rand(3, generator=self.views_rng) if at_random else None))
        return batch

    def views_of(self, step: int) -> range:
        """Return the numbers, from 1, of the views that the optimiser step at iteration `step`
        sees."""
        return range(step - self.cfg.batch + 1, step + 1)

    def seed_view(self, number: int) -> None:
        """Make the random numbers of a view, such as dropped anchors, depend on its number alone.
        No effect for a batch of one view."""
        if self.cfg.batch > 1:
            digest = hashlib.blake2b(f"{self.cfg.seed} {number}".encode(), digest_size=8).digest()
            torch.manual_seed(int.from_bytes(digest, "little") >> 1)

    def set_rates(self) -> None:
        """Set the learning rates of the iteration. They grow with the batch to the power
        `batch_rates`."""
        for group in self.optimizer.param_groups:
            own = None if self.rate is None else self.rate.learning_rate(group["name"], self.step)
            for name, learned in ((exposure.GROUP, self.scene.exposures), (poses.GROUP, self.scene.poses)):
                if group["name"] == name and learned is not None:
                    own = learned.learning_rate(self.step, self.cfg.iterations)
            rate = self.cfg.rates.at(group["name"], self.step, self.cfg.iterations, self.scene.extent) if own is None else own
            group["lr"] = rate * self.cfg.batch**self.cfg.batch_rates

    def add_groups(self, groups: Mapping[str, list[torch.nn.Parameter]]) -> None:
        """Let the optimiser move more parameters, by the names of their learning rates."""
        columns = self.scene.table.params
        for name, params in groups.items():
            self.optimizer.add_param_group({"params": params, "name": name, "lr": 0.0, "by_row": name in columns})

    def optimizer_step(self, rows: Tensor | None = None) -> None:
        """Run one optimiser step and remove the gradients. rows: [A] int64, the only rows of the
        table to update; None updates all."""
        if rows is None:
            self.optimizer.step()
        else:
            self.optimizer.step(rows=rows)  # type: ignore[call-arg]
        self.optimizer.zero_grad(set_to_none=True)

    @property
    def growth(self) -> Strategy[Any]:
        """The rule by which rows are created and removed."""
        return self.cfg.growth.within(self.box) if self.box else self.cfg.growth

    def companions(self, parameter: Tensor) -> list[Tensor]:
        """Return the tensors that follow a parameter of a network, each of its shape: the
        optimiser's moments and the average."""
        moments = [t for t in self.optimizer.state.get(parameter, {}).values() if t.shape == parameter.shape]
        averages = self.averages.networks if self.averages is not None else {}
        return moments + [averages[name] for name, p in self.scene.network_tensors().items() if p is parameter and name in averages]

    def update_averages(self) -> None:
        """Update the averages of the weights after an optimiser step, if they are due."""
        if self.averages is None:
            return
        for number in self.views_of(self.step):
            if self.cfg.average.due(number):
                self.averages.update(self.cfg.average.weight(number, self.cfg.iterations))

    def averaged(self) -> AbstractContextManager[None]:
        """Context manager in which the scene has its averaged weights, as in the saved run. No
        effect without averages."""
        return nullcontext() if self.averages is None else self.averages.swapped()

    def averaged_scene(self) -> Scene:
        """Return a copy of the scene with its averaged weights, as in the saved run; without
        averages the scene itself."""
        if self.averages is None:
            return self.scene
        own = {name: value.clone() for name, value in self.tensors().items() if name.startswith(("average.", "facts."))}
        made = restore_scene(self.cfg.scene, own, self.meta(), averaged=True).to(self.scene.table.device)
        made.exposures, made.poses = self.scene.exposures, self.scene.poses
        return made

    def rates(self) -> dict[str, float]:
        """Return the current learning rates by group."""
        return {group["name"]: group["lr"] for group in self.optimizer.param_groups}

    def tensors(self) -> dict[str, Tensor]:
        """Return the state as named tensors."""
        table = self.scene.table
        out = {f"params.{k}": v.detach() for k, v in table.params.items()}
        out |= {f"facts.{k}": v for k, v in table.facts.items()} | {f"stats.{k}": v for k, v in table.stats.items()}
        out |= {f"network.{k}": v.detach() for k, v in self.scene.network_tensors().items()}
        for group in self.optimizer.param_groups:
            for i, parameter in enumerate(group["params"]):
                for key, value in self.optimizer.state.get(parameter, {}).items():
                    if isinstance(value, Tensor):
                        out[f"{self.cfg.optimizer.prefix}.{group['name']}.{i}.{key}"] = value
        out |= {"rng.torch": torch.get_rng_state(), "rng.views": self.views_rng.get_state(), "rng.growth": self.growth_rng.get_state()}
        if table.device.type == "cuda":
            out["rng.cuda"] = torch.cuda.get_rng_state(table.device)
        if self.averages is not None:
            out |= self.averages.tensors()
        out |= {} if self.rate is None else self.rate.tensors(self.scene)
        for learned in (self.scene.exposures, self.scene.poses):
            out |= {} if learned is None else learned.tensors()
        out["queue"] = torch.tensor(self.queue, dtype=torch.int64)
        return out

    def meta(self) -> dict[str, Any]:
        return {
            "recipe": self.cfg.recipe,
            "step": self.step,
            **self.clock.meta(),
            **self.scene.meta(),
            "train": to_json(self.cfg),
            "capture": self.capture_id,
            "poses": self.poses,
            "chosen": self.chosen,
            **({"box": list(self.box)} if self.box else {}),
        }

    @classmethod
    def restore(cls, cfg: Train, tensors: dict[str, Tensor], meta: dict[str, Any], device: str) -> Training:
        """Restore a training from a checkpoint. Raises InputError if the checkpoint has another
        configuration."""
        check_same(cfg, meta)
        scene = restore_foreign(cfg.scene, tensors, meta)
        scene.exposures = Exposures.restore(tensors) if cfg.exposure else None
        scene.poses = Poses.restore(tensors)  # without --refine-poses too: those of --init-from
        restore_stats(scene, tensors)
        training = cls(cfg, scene.to(device))
        table = training.scene.table
        if training.rate is not None and training.scene.rounding is not None:
            groups = training.rate.prepare(training.scene)
            training.add_groups({MODEL: groups[MODEL]})  # the scene's own are there
            training.rate.restore(training.scene, tensors)
        restore_moments(cfg.optimizer, training.optimizer, tensors)
        if training.averages is not None:
            training.averages.restore(tensors)
        torch.set_rng_state(tensors["rng.torch"])
        if "rng.cuda" in tensors and table.device.type == "cuda":
            torch.cuda.set_rng_state(tensors["rng.cuda"], table.device)
        training.views_rng.set_state(tensors["rng.views"])
        training.growth_rng.set_state(tensors["rng.growth"])
        training.queue = tensors["queue"].tolist()
        training.step, training.clock = int(meta["step"]), Clock.of(meta)
        training.capture_id, training.poses = meta.get("capture", ""), meta.get("poses", "")
        training.chosen, training.box = meta.get("chosen"), tuple(meta.get("box", ()))
        return training


def new_exposures(cfg: Train, capture: Capture, earlier: Exposures | None = None) -> Exposures | None:
    """Return the exposures of a training that begins, from those of an earlier one of the same
    scene; None where it learns none."""
    if not cfg.exposure:
        return None
    made = Exposures([capture.views[i].camera for i in capture.train])
    if earlier is not None:
        made.continue_from(earlier)
    return made


def new_poses(cfg: Train, capture: Capture, earlier: Poses | None = None) -> Poses | None:
    """Return the motions of the cameras of a training that begins, from those of an earlier one of
    the same scene; None where there are none."""
    if not cfg.refine_poses:
        return earlier
    made = Poses([capture.views[i].camera for i in capture.train], capture.extent)
    if earlier is not None:
        made.continue_from(earlier)
    return made


def check_same(cfg: Train, meta: dict[str, Any]) -> None:
    """Raise InputError if the checkpoint of `meta` was trained with settings other than `cfg`,
    which must be scaled."""
    if "train" not in meta:
        other = "it was imported, and has no state of an optimiser"
    else:
        other = few(differences(to_json(from_json(Train, meta["train"])), to_json(cfg)), MOST_DIFFERENCES)
    if other:
        raise InputError(
            f"expected a checkpoint of this configuration, found one trained with other settings: {other}; "
            "resume with the run's own flags, or start in another --out folder"
        )


def save(training: Training, folder: Path, keep: int, tensors: dict[str, Tensor] | None = None) -> Path:
    """Write a checkpoint atomically and return its path. The newest `keep` checkpoints are
    kept; 0: all.

    tensors: The state as named tensors, if it is divided among several processes; None means
    `training.tensors()`.

    Raises RunError if a number of the state is not finite. Earlier checkpoints are then unchanged.
    """
    tensors = training.tensors() if tensors is None else tensors
    tensors = {k: v.detach().cpu().contiguous() for k, v in tensors.items()}
    check_state(tensors, training.step, folder)
    return checkpoint.save(folder, training.step, tensors, training.meta(), keep=keep)


def resume(cfg: Train, folder: Path, device: str) -> Training | None:
    """Restore the newest valid checkpoint of a run. Return None if there is no checkpoint.

    Raises InputError if all checkpoints are damaged or if the configuration differs.
    """
    found = checkpoint.newest(folder)
    if found is None and any(folder.glob("ckpt_*.safetensors")):
        raise InputError(f"expected a whole checkpoint in {folder}, found only damaged ones; copy one back, or begin anew with --overwrite")
    if found is None:
        return None
    tensors, meta = found
    checkpoint.expect(meta, recipe=cfg.recipe)
    with guarding(folder, RUN):
        return Training.restore(cfg, tensors, meta, device)
