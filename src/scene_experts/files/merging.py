"""Merges the runs of blocks into one run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from scene_experts.core import checkpoint
from scene_experts.core.errors import InputError
from scene_experts.data.blocks import read_plan
from scene_experts.files.export import write_result_folder
from scene_experts.scene import Scene
from scene_experts.training import run_folder


def merge_blocks(plan: Path, runs: Sequence[Path], out: Path) -> int:
    """Merge trained blocks into one scene: from each run, the anchors inside its own box. Returns the number of anchors.

    Args:
        plan: The folder of the plan.
        runs: The run folders of the blocks, in the order of the plan.
        out: New run folder, with configuration, checkpoint and result folder.

    Raises:
        InputError: The number of runs differs from that of the blocks, or the runs have other captures, lattices or networks than the
            first one. The message names the run.
    """
    fingerprint, blocks = read_plan(plan)
    if len(runs) != len(blocks):
        raise InputError(f"expected {len(blocks)} runs, one for each block of {plan}, found {len(runs)}; name them in the plan's order")
    opened = [run_folder.open_run(run) for run in runs]
    first = opened[0]
    for run in opened:
        if not run.scene.traits.voxel:
            raise InputError(f"expected a scene of anchors in {run.path}, found one of {run.scene.traits.rows}; train an anchor recipe")
        if run.capture != fingerprint:
            raise InputError(f"expected a run on the capture of the plan, found one on another in {run.path}; use the plan's command")
        _check_same(first.scene, run.scene, run.path)
    tensors: dict[str, Tensor] = {f"network.{name}": value.detach() for name, value in first.scene.network_tensors().items()}
    kept = [block.holds(run.scene.positions.detach()) for block, run in zip(blocks, opened)]
    for name in first.scene.table.columns():
        kind = "params" if name in first.scene.table.params else "facts"
        columns = [run.scene.table.columns()[name].detach()[rows] for run, rows in zip(opened, kept)]
        tensors[f"{kind}.{name}"] = torch.cat(columns)
    data = replace(first.config.data, views=None)
    config = replace(first.config, data=data, command=f"merged from {len(runs)} blocks", versions=run_folder.versions(), stop_at=None)
    step = max(run.step for run in opened)
    run_folder.prepare(out, config, resume=False)
    seconds = sum(run.clock.seconds for run in opened)
    meta = {"recipe": config.train.recipe, "step": step, "seconds": seconds, "capture": fingerprint}
    checkpoint.save(out / "checkpoints", step, tensors, {**first.scene.meta(), **meta, "config": "imported"})
    merged = run_folder.open_run(out)
    capture = run_folder.capture_of(merged)
    try:
        write_result_folder(merged, capture)
    finally:
        capture.images.close()
    return len(merged.scene.table)


def _check_same(first: Scene, other: Scene, path: Path) -> None:
    """Raise InputError unless two scenes have the same lattice and networks."""
    lattice, found = first.meta(), other.meta()
    if lattice != found:
        raise InputError(f"expected the lattice of the first block in {path}, found another; begin all blocks with the same --init-from")
    mine, its = first.network_tensors(), other.network_tensors()
    if mine.keys() != its.keys() or not all(torch.equal(mine[name], its[name]) for name in mine):
        raise InputError(
            f"expected the networks of the first block in {path}, found others; "
            "begin all blocks with the same --init-from and train them with --rates.networks 0"
        )
