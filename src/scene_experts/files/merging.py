"""Merges the runs of blocks into one run."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from scene_experts.core import checkpoint
from scene_experts.core.errors import InputError
from scene_experts.data.blocks import Block, read_plan
from scene_experts.data.views import Vector, same_poses
from scene_experts.files.scene_folder import write_result_folder
from scene_experts.scene import Scene
from scene_experts.scene.anchors.quantise import CLASS
from scene_experts.training import run_folder
from scene_experts.training.config import RunConfig
from scene_experts.training.run_folder import OpenRun

log: logging.Logger = logging.getLogger(__name__)


def merge_blocks(plan: Path, runs: Sequence[Path], out: Path) -> int:
    """Merge trained blocks into one scene: from each run, the anchors inside its own box. Returns
    the number of anchors.

    Args:
        plan: The folder of the plan.
        runs: The run folders of the blocks, in the order of the plan.
        out: New run folder, with configuration, checkpoint and result folder.

    Raises:
        InputError: The number of runs differs from that of the blocks, a run was trained for
            another box, or the runs have other captures, lattices or networks than the first one.
            The message names the run.
    """
    fingerprint, blocks = read_plan(plan)
    if len(runs) != len(blocks):
        raise InputError(f"expected {len(blocks)} runs, one for each block of {plan}, found {len(runs)}; name them in the plan's order")
    parts = _Parts(fingerprint)
    for number, path in enumerate(runs):  # one run in memory at a time
        parts.add(run_folder.open_run(path), path, blocks, number)
    data = replace(parts.configs[0].data, views=None, near=_nearest(parts.configs), background=_behind(parts.configs))
    command = f"merged from {len(runs)} blocks"
    config = replace(parts.configs[0], data=data, command=command, versions=run_folder.versions(), stop_at=None, init_from=None)
    run_folder.prepare(out, config, resume=False)
    parts.save(out)
    merged = run_folder.open_run(out)
    capture = run_folder.capture_of(merged)
    try:
        write_result_folder(merged, capture)
    finally:
        capture.images.close()
    return len(merged.scene.table)


@dataclass
class _Parts:
    """What the merged run takes from the runs of the blocks that were added."""

    fingerprint: str  # of the capture
    configs: list[RunConfig] = field(default_factory=list)
    columns: dict[str, list[Tensor]] = field(default_factory=dict)  # rows by block
    slots: list[Tensor] = field(default_factory=list)  # rows by block
    has_slots: bool = False
    networks: dict[str, Tensor] = field(default_factory=dict)  # those of the first block, and of each
    lattice: dict[str, Any] = field(default_factory=dict)  # the same
    poses: str = ""
    box: tuple[float, ...] = ()  # in which the runs created rows, from the run that all began with
    step: int = 0
    seconds: float = 0.0

    def add(self, run: OpenRun, path: Path, blocks: Sequence[Block], number: int) -> None:
        """Add the anchors inside the own box of block `number`. Raises InputError as `merge_blocks`."""
        scene = run.scene
        self._check(run, path)
        _check_box(blocks, number, run)
        if not self.configs:
            self.networks = {name: value.detach().clone() for name, value in scene.network_tensors().items()}
            self.lattice = _lattice(scene)
        _check_same(self.lattice, self.networks, scene, path)
        rows = blocks[number].holds(scene.positions.detach())
        self.slots.append(scene.table.facts.get("slots", torch.ones(len(scene.table), scene.K, dtype=torch.bool))[rows])
        self.has_slots |= "slots" in scene.table.facts
        for name, column in scene.table.columns().items():
            if name in ("slots", CLASS):
                continue
            kind = "params" if name in scene.table.params else "facts"
            self.columns.setdefault(f"{kind}.{name}", []).append(column.detach()[rows])
        self.configs.append(run.config)
        self.poses, self.box = self.poses or run.poses, self.box or run.box
        self.step, self.seconds = max(self.step, run.step), self.seconds + run.clock.seconds

    def _check(self, run: OpenRun, path: Path) -> None:
        scene = run.scene
        if not scene.traits.voxel:
            raise InputError(f"expected a scene of anchors in {path}, found one of {scene.traits.rows}; train an anchor recipe")
        if run.capture != self.fingerprint:
            raise InputError(f"expected a run on the capture of the plan, found one on another in {path}; use the plan's command")
        if scene.poses is not None:
            raise InputError(f"expected blocks on the poses of the capture, found refined ones in {path}; train it without --refine-poses")
        if scene.exposures is not None:
            raise InputError(f"expected blocks without learned exposures, found a run with them in {path}; train it without --exposure")
        if not same_poses(self.poses, run.poses):
            raise InputError(f"expected runs on one capture, found other camera poses in {path} than in the first block; train it again")

    def save(self, out: Path) -> None:
        """Write the checkpoint of the merged run, and let go of the parts."""
        tensors = {f"network.{name}": value for name, value in self.networks.items()}
        for name in list(self.columns):
            tensors[name] = torch.cat(self.columns.pop(name))
        if self.has_slots:
            tensors["facts.slots"] = torch.cat(self.slots)
        config = self.configs[0]
        meta = {"recipe": config.train.recipe, "step": self.step, "seconds": self.seconds, "capture": self.fingerprint, "poses": self.poses}
        meta |= {"box": list(self.box)} if self.box else {}
        checkpoint.save(out / "checkpoints", self.step, tensors, {**self.lattice, **meta, "config": "imported"})


def _check_box(blocks: Sequence[Block], number: int, run: OpenRun) -> None:
    """Raise InputError if a run was trained for another box than that of its block. Warns if its
    training has not ended."""
    train, last = run.config.train, run.config.stop_at or run.config.train.iterations
    bounds = train.growth.box  # empty: a run that creates anchors everywhere fits every block
    if bounds and not _is_same_box(bounds, blocks[number]):
        other = next((f"that of block {i}" for i, block in enumerate(blocks) if _is_same_box(bounds, block)), "one of another plan")
        raise InputError(f"expected the run of block {number} at {run.path}, found {other}; name the runs in the plan's order")
    if run.step < last:
        log.warning("the run of block %d ended at iteration %s of %s: %s", number, f"{run.step:,}", f"{last:,}", run.path)


def _is_same_box(bounds: Sequence[float], block: Block) -> bool:
    return all(math.isclose(a, b, rel_tol=1e-5) for a, b in zip(bounds, block.bounds))  # a plan writes six digits


def _nearest(configs: Sequence[RunConfig]) -> float | None:
    """Return the least near plane of the blocks: each has that of its own views (`--near-share`). None,
    the default, if a block has it."""
    planes = [config.data.near for config in configs]
    return None if None in planes else min(near for near in planes if near is not None)


def _behind(configs: Sequence[RunConfig]) -> Vector | None:
    """Return the background: the mean of those of the blocks, where each has the mean colour of its own
    views (`--mean-background`), else that of the first."""
    colours = [config.data.background for config in configs if config.train.mean_background]
    known = [colour for colour in colours if colour is not None]
    if len(known) < len(configs):
        return configs[0].data.background
    red, green, blue = (round(sum(channel) / len(known), 3) for channel in zip(*known))
    return red, green, blue


def _lattice(scene: Scene) -> dict[str, Any]:
    """`Scene.meta` without the steps that a block has learned with --rate, which differ between
    blocks: the merged scene is rounded anew."""
    return {name: value for name, value in scene.meta().items() if name != "steps"}


def _check_same(lattice: dict[str, Any], networks: dict[str, Tensor], scene: Scene, path: Path) -> None:
    """Raise InputError unless a scene has this lattice and these networks."""
    found = _lattice(scene)
    if lattice != found:
        raise InputError(f"expected the lattice of the first block in {path}, found another; begin all blocks with the same --init-from")
    its = scene.network_tensors()
    if networks.keys() != its.keys() or not all(torch.equal(value, its[name]) for name, value in networks.items()):
        raise InputError(
            f"expected the networks of the first block in {path}, found others; "
            "begin all blocks with the same --init-from and train them with --rates.networks 0"
        )
