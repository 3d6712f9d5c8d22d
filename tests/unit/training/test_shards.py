"""Anchors that are divided among the processes. Groups are forked processes on this machine that exchange over gloo."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from scene_experts.core import checkpoint
from scene_experts.core.errors import InputError
from scene_experts.training.average import Average
from scene_experts.training.events import Densified, Previewed
from scene_experts.training.recipes import RECIPES
from scene_experts.training.shards import check_shard
from support.groups import run_group
from support.synthetic import make_capture
from support.trainings import assert_same, config, events, last_tensors


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return make_capture(tmp_path_factory.mktemp("capture"), views=8, size=(48, 32), points=400).folder


def of_recipe(recipe: str, **changes) -> Any:
    """A recipe with a batch of 4 that creates and removes anchors from iteration 20 on."""
    cfg: Any = config(recipe, batch=4, iterations=240, schedule=240, random_background=True, **changes)
    growth = replace(cfg.growth, adjust=replace(cfg.growth.adjust, start=9, stop=200, interval=20), start_stat=5, grad_threshold=1e-4)
    cfg = replace(cfg, growth=replace(growth, min_opacity=0.5), scene=replace(cfg.scene, dropout=0.3, view_jitter=0.4))
    decoder = cfg.scene.decoder
    return replace(cfg, scene=replace(cfg.scene, decoder=replace(decoder, warmup=30))) if hasattr(decoder, "warmup") else cfg


def train(group, cfg, folder, out, **run) -> list:
    return list(events(cfg, folder, out, group=group, ordered=True, shard=True, **run))


@pytest.mark.slow
@pytest.mark.parametrize(("recipe", "sizes"), [("moe-gs", (2, 4)), ("moe-gs-balance", (2,)), ("scene-experts", (4,))])
def test_bits_do_not_depend_on_the_number_of_processes(recipe, sizes, folder, tmp_path):
    cfg = of_recipe(recipe)
    seen = list(events(cfg, folder, tmp_path / "whole", ordered=True, shard=True, stop_at=44))
    assert any(e.edit.grown for e in seen if isinstance(e, Densified))
    for size in sizes:
        out = tmp_path / str(size)
        assert run_group(size, lambda g: train(g, cfg, folder, out, stop_at=44), timeout=60) == [0] * size  # noqa: B023
        assert_same(last_tensors(tmp_path / "whole"), last_tensors(out))


@pytest.mark.slow
def test_a_run_with_sparse_adam_continues_with_and_without_shards(folder, tmp_path):
    cfg = of_recipe("moe-gs", sparse_adam=True, average=Average(span=0.2), max_anchors=600)
    cfg = replace(cfg, scene=replace(cfg.scene, appearance=4))
    whole = list(events(cfg, folder, tmp_path / "whole", ordered=True, stop_at=48, preview_every=16))

    def part(group):
        seen = train(group, cfg, folder, tmp_path / "parts", stop_at=32, preview_every=16)
        shown = [e for e in seen if isinstance(e, Previewed)]
        expected = [e for e in whole if isinstance(e, Previewed)][:2] if group.first else []
        assert all(torch.equal(a.picture, b.picture) for a, b in zip(shown, expected, strict=True))

    assert run_group(2, part, timeout=60) == [0, 0]
    assert "facts.number" not in last_tensors(tmp_path / "parts")
    list(events(cfg, folder, tmp_path / "parts", ordered=True, stop_at=40, resume=True))
    assert run_group(4, lambda g: train(g, cfg, folder, tmp_path / "parts", stop_at=48, resume=True), timeout=60) == [0] * 4
    assert_same(last_tensors(tmp_path / "whole"), last_tensors(tmp_path / "parts"))
    edits = [e.edit for e in whole if isinstance(e, Densified)]
    assert any(e.capped for e in edits) and any(e.pruned for e in edits)


def test_one_process_holds_all_rows(folder, tmp_path):
    cfg = of_recipe("scaffold-gs", sparse_adam=True)
    list(events(cfg, folder, tmp_path / "whole", ordered=True, stop_at=24))
    list(events(cfg, folder, tmp_path / "shard", ordered=True, stop_at=24, shard=True))
    assert_same(last_tensors(tmp_path / "whole"), last_tensors(tmp_path / "shard"))
    assert checkpoint.latest(tmp_path / "shard" / "checkpoints") is not None


@pytest.mark.parametrize("recipe", ["3dgs", "3dgs-mcmc", "sags", "octree-gs"])
def test_recipes_that_need_the_whole_table_are_refused(recipe):
    with pytest.raises(InputError, match="--shard"):
        check_shard(RECIPES[recipe][1], 0.0, False)


def test_settings_that_need_the_whole_table_are_refused():
    cfg: Any = RECIPES["moe-gs"][1]
    check_shard(cfg, 0.0, False)
    with pytest.raises(InputError, match=r"--growth\.error-views"):
        check_shard(replace(cfg, growth=replace(cfg.growth, error_views=3)), 0.0, False)
