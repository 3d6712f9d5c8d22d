"""A training with every switch of growth, masks, smoothing and residual weights at once."""

from dataclasses import replace

from scene_experts.training.events import Densified
from support.synthetic import make_capture
from support.trainings import assert_same, config, events, last_tensors


def test_a_training_with_every_switch_resumes_bit_for_bit(tmp_path):
    folder = make_capture(tmp_path / "capture", views=16).folder
    cfg = config("moe-gs")
    growth = replace(cfg.growth, gradient="absolute", error_views=3, error_share=0.1, least_contribution=0.01, mask_contribution=0.05)
    cfg = replace(cfg, growth=replace(growth, mask_at=(3500,)), scene=replace(cfg.scene, smoothing=0.2))  # 70 of 600
    cfg = replace(cfg, loss=replace(cfg.loss, residual_quantile=0.9, residual_from=0))
    edits = [e for e in events(cfg, folder, tmp_path / "whole", stop_at=100) if isinstance(e, Densified)]
    assert any(e.edit.grown for e in edits) and any(e.step == 70 for e in edits)
    list(events(cfg, folder, tmp_path / "parts", stop_at=65))
    list(events(cfg, folder, tmp_path / "parts", stop_at=100, resume=True))
    tensors = last_tensors(tmp_path / "whole")
    assert_same(tensors, last_tensors(tmp_path / "parts"))
    assert not tensors["facts.slots"].all() and (tensors["facts.interval"] > 0).all() and "stats.covered" in tensors
