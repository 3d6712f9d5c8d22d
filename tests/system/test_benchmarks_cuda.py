"""Plan, arguments and resuming of the CUDA benchmarks, on the CPU."""

import sys
import time
from pathlib import Path

import pytest
import torch

import decode_cuda
import explicit_gsplat
import train_cuda
from scene_experts.core.types import Camera, Gaussians
from scene_experts.render.reference import ReferenceRasterizer
from support.synthetic import make_capture


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return make_capture(tmp_path_factory.mktemp("capture"), views=8, size=(24, 16)).folder


def draw(p, camera, degree, background):
    """The reference rasteriser in place of gsplat, without harmonics."""
    quats = torch.nn.functional.normalize(p["quats"], dim=1)
    colors = (0.28209479 * p["dc"][:, 0] + 0.5).clamp_min(0)
    g = Gaussians(p["means"], quats, p["scales"].exp(), p["opacities"].sigmoid(), colors, torch.arange(len(quats)))
    return ReferenceRasterizer()(g, camera, background).image


def test_each_recipe_is_followed_by_a_peer_of_its_size():
    recipes, Peer = ["scaffold-gs", "moe-gs"], train_cuda.Peer
    assert train_cuda.list_pending(recipes, {}) == ["scaffold-gs", Peer(0), "moe-gs"]
    results = {"scaffold-gs": {"done": True, "gaussians": 70}, "moe-gs": {"step": 3}}
    assert train_cuda.list_pending(recipes, results) == [Peer(70), "moe-gs", Peer(0)]
    results |= {"moe-gs": {"done": True, "gaussians": 70}, Peer(70).name: {"done": True}}
    assert train_cuda.list_pending(recipes, results) == []
    assert train_cuda.list_pending(recipes, results, losses=("triton", "torch")) == [Peer(70, "torch")]
    assert train_cuda.list_pending(recipes, results, count=80) == [Peer(80)]


def test_a_ratio_is_to_the_peer_of_the_same_size():
    def done(ms, count):
        return {"step": 100, "seconds": ms / 10, "peak_bytes": 0, "gaussians": count, "done": True}

    results = {"scaffold-gs": done(4, 70), "gsplat, 70": done(5, 70), "gsplat, 70, torch loss": done(9, 70), "moe-gs": done(6, 80)}
    lines = {line[:32].strip(): line[32:].split() for line in train_cuda.format_table(results).splitlines()}
    assert lines["scaffold-gs"][3] == "0.80" and lines["gsplat, 70"][3] == "1.00"
    assert lines["gsplat, 70, torch loss"][3] == lines["moe-gs"][3] == "0"  # the peak memory: no ratio


@pytest.mark.slow
def test_slices_until_the_table(folder, tmp_path, capsys):
    line = ["--data", str(folder), "--out", str(tmp_path), "--device", "cpu", "--iterations", "6", "--recipes", "moe-gs", "--count", "50"]
    train_cuda.main([*line, "--seconds", "0"], draw)
    assert "moe-gs" in capsys.readouterr().out
    train_cuda.main([*line, "--seconds", "120"], draw)
    out = capsys.readouterr().out
    assert "moe-gs" in out
    with pytest.raises(SystemExit, match="iterations"):
        train_cuda.main([*line, "--iterations", "7"], draw)


def test_the_peer_resumes(folder, tmp_path):
    from support.captures import load

    capture = load(folder)
    whole = explicit_gsplat.Training(capture, 60, 6, tmp_path / "whole", "cpu", draw)
    assert whole.run(time.monotonic() + 100)
    half = explicit_gsplat.Training(capture, 60, 6, tmp_path / "parts", "cpu", draw)
    for _ in range(3):
        half.iterate()
    half.save()
    again = explicit_gsplat.Training(capture, 60, 6, tmp_path / "parts", "cpu", draw)
    assert again.step == 3 and not again.run(time.monotonic() - 1) and again.run(time.monotonic() + 100)
    assert all(torch.equal(p, again.params[name]) for name, p in whole.params.items())
    assert (whole.params["means"] != explicit_gsplat.initialise(capture, 60)["means"]).any()


@pytest.mark.skipif(torch.cuda.is_available(), reason="a CUDA device")
def test_without_a_gpu_they_say_so(folder, tmp_path, monkeypatch):
    with pytest.raises(SystemExit, match="CUDA"):
        train_cuda.main(["--data", str(folder), "--out", str(tmp_path)])
    monkeypatch.setattr(sys, "argv", ["decode_cuda.py"])
    with pytest.raises(SystemExit, match=r"CUDA|triton"):
        decode_cuda.main()


def test_the_least_traffic_is_counted_by_hand():
    # one anchor of two seen, one Gaussian drawn, F = 1, K = 2, one network
    forward = (8 + 12 + 4 + 24) + 12 + 2 * 4 + 64
    backward = (8 + 12 + 4 + 24) + 12 + 2 * (2 * 4 + 56) + 2 * 4 * (1 + 6 + 6)
    assert decode_cuda.compute_least_bytes(2, 1, 1, 1, 2, 1) == (forward, backward)


def test_every_decoder_is_run_and_reported(monkeypatch):
    def timed(work):
        work()
        return 2.0

    monkeypatch.setattr(decode_cuda, "time_on_device", timed)
    rows, cases = torch.arange(0, 60, 2), {}
    camera = Camera(torch.eye(4), torch.eye(3), 80, 54)
    for kind, config in decode_cuda.KINDS.items():
        for form in ("composed", "auto"):
            case = cases[kind, form] = decode_cuda.Case(decode_cuda.make_scene(config, 60, "cpu"), rows, camera, form)
            for _ in range(decode_cuda.WARM_UP + 1):
                case.run()
    lines = decode_cuda.format_report(cases, 60, 30, 1e6)
    assert len(lines) == 6 and all("1.00x" in line for line in lines)
