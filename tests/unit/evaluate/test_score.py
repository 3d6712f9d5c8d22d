"""An evaluation of a scene with known renders: files, scores, masks, errors."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.table import Table
from scene_experts.core.types import Camera, Decoded, Gaussians, Mode, Render, Routing
from scene_experts.evaluate import metrics, pictures, score, weights
from scene_experts.evaluate.options import EvalOptions
from scene_experts.evaluate.results import About
from scene_experts.evaluate.score import evaluate
from scene_experts.scene import Scene, Traits
from support.groups import run_group
from support.lpips import random_tensors
from support.messages import naming

N, K, F, H, W = 6, 4, 8, 36, 48


def photo(index: int) -> Tensor:
    """Return a smooth picture [H, W, 3] uint8, a different one for each view."""
    y, x = torch.meshgrid(torch.arange(H), torch.arange(W), indexing="ij")
    return torch.stack([(4 * x + 10 * index) % 256, (5 * y) % 256, (x + y) % 256], dim=2).to(torch.uint8)


@dataclass(frozen=True)
class FakeCapture:
    """A capture with views 0 to 3, of which 0 and 2 are held out."""

    train: tuple[int, ...] = (1, 3)
    test: tuple[int, ...] = (0, 2)
    mask: Tensor | None = None
    name: str = "yard"
    resolution: str = "as-is"
    split: str = "mod2"
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    alpha_over: tuple[float, float, float] | None = None
    points: Any = None
    omitted: tuple[str, ...] = ()

    @property
    def images(self) -> Any:
        return SimpleNamespace(prefetch=lambda ids: None)

    @property
    def views(self) -> list[Any]:
        camera = Camera(torch.eye(4), torch.eye(3), W, H)
        return [SimpleNamespace(name=f"day/{i}.jpg", camera=replace(camera, id=i)) for i in range(4)]

    def frame(self, index: int) -> Any:
        return SimpleNamespace(rgb=photo(index), mask=self.mask)

    def poses(self):
        return ""

    def photographs(self):
        return "files"


class FakeScene(Scene):
    """A scene that decodes 2 of 6 anchors. 3 of their 8 Gaussians have positive opacity."""

    K = K
    file_values = 9
    traits = Traits("fake", "anchors", 0.1, activation=True)

    def __init__(self, routed: bool = True) -> None:
        params = {"feature": torch.zeros(N, F), "offsets": torch.zeros(N, K, 3), "log_scaling": torch.zeros(N, 6)}
        super().__init__(Table(params, {}), 5.0)
        self.routed = routed

    def forward(self, camera: Camera, step: int, mode: Mode, cull: Any) -> Decoded:
        assert mode is Mode.DRAW and not torch.is_grad_enabled() and step == 700
        m = 3
        gaussians = Gaussians(torch.zeros(m, 3), torch.zeros(m, 4), torch.ones(m, 3), torch.ones(m), torch.ones(m, 3), torch.arange(m))
        raw = torch.full((2, K), -0.5)
        raw[0, :3] = 0.5
        return Decoded(
            gaussians, torch.tensor([0, 4]), raw, {a: Routing(r.gates[::4], r.chosen[::4]) for a, r in self.routing(step).items()}
        )

    def routing(self, step: int, most: int | None = None) -> dict[str, Routing]:
        return {"color": Routing(torch.full((N, 2), 0.5), torch.tensor([[0]] * 3 + [[1]] * 3))} if self.routed else {}

    def network_tensors(self) -> dict[str, Tensor]:
        return {"color.w1": torch.zeros(10, 5)}


class FakeRasterizer:
    """Draws the photograph with `error` added. One of three Gaussians is outside the picture."""

    name = "fake"

    def __init__(self, error: float = 0.1, where: slice = slice(None)) -> None:
        self.error, self.where = error, where

    def __call__(self, gaussians: Gaussians, camera: Camera, background: Tensor) -> Render:
        image = photo(camera.id).float() / 255
        image[:, self.where] += self.error
        return Render(image, torch.ones(H, W), torch.ones(H, W), torch.tensor([3, 0, 5], dtype=torch.int32), torch.zeros(3, 2))

    def visible(self, *_: Any) -> Tensor:
        return torch.ones(2, dtype=torch.bool)


@pytest.fixture(autouse=True)
def no_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    def load(net: str, explicit: Path | None = None) -> tuple[dict[str, Tensor], str]:
        raise weights.MissingWeights(f"no weights of LPIPS ({net}): run this")

    monkeypatch.setattr(weights, "load", load)


def evaluated(out: Path, capture: Any = None, rasterize: Any = None, scene: Any = None, **options: Any) -> dict[str, Any]:
    more = {name: options.pop(name) for name in ("about", "progress", "group") if name in options}
    parts = (scene or FakeScene(), capture or FakeCapture(), rasterize or FakeRasterizer())
    return evaluate(*parts, out, EvalOptions(**options), step=700, **more)


def test_files_and_figures(tmp_path: Path) -> None:
    seen: list[tuple[str, int, int]] = []
    about = About("moe-gs", 1000, 3, 12.5, {"torch": "x"})
    results = evaluated(tmp_path, about=about, progress=lambda *args: seen.append(args))
    for kind in ("renders", "gt", "errors", "side_by_side"):
        assert sorted(p.relative_to(tmp_path).as_posix() for p in (tmp_path / "test" / kind).rglob("*.png")) == [
            f"test/{kind}/day/{i}.png" for i in (0, 2)
        ]
    assert np.array_equal(pictures.read_picture(tmp_path / "test" / "gt" / "day" / "2.png"), photo(2).numpy())
    assert json.loads((tmp_path / "results.json").read_text()) == results
    per_view = json.loads((tmp_path / "per_view.json").read_text())
    assert list(per_view) == ["day/0.jpg", "day/2.jpg"]
    assert results["psnr"] == pytest.approx(np.mean([per_view[name]["psnr"] for name in per_view]))
    assert results["activation_ratio"] == pytest.approx(3 / 8) and results["gaussians_rendered"] == 2
    assert results["anchors"] == N and results["gaussians"] == N * K
    assert results["experts"]["color"]["share"] == [0.5, 0.5] and results["experts"]["color"]["entropy"] == pytest.approx(1)
    assert results["recipe"] == "moe-gs" and results["iterations"] == 1000 and results["seed"] == 3 and results["train_seconds"] == 12.5
    assert results["capture"] == "yard" and results["split"] == "mod2" and results["resolution"] == "as-is" and results["view_count"] == 2
    assert results["rasterizer"] == "fake" and results["fps"]["fps"] > 0 and results["sharpness"]["ratio"] > 0
    assert set(results["variants"]) == {"psnr", "ssim", "lpips", "lpips_3dgs", "lpips_alex"}
    assert seen == [("rendering and scoring", 1, 2), ("rendering and scoring", 2, 2)]


def test_two_processes_share_the_views(tmp_path: Path) -> None:
    def member(group: Any) -> None:
        results = evaluated(tmp_path / "two", group=group)
        assert bool(results) == group.first

    one = evaluated(tmp_path / "one")
    assert run_group(2, member) == [0, 0]
    assert (tmp_path / "one" / "per_view.json").read_bytes() == (tmp_path / "two" / "per_view.json").read_bytes()
    two = json.loads((tmp_path / "two" / "results.json").read_text())
    assert (one["psnr"], one["ssim"], one["view_count"]) == (two["psnr"], two["ssim"], two["view_count"])
    assert len(list((tmp_path / "two" / "test" / "side_by_side").rglob("*.png"))) == 2


def test_a_score_that_one_process_lacks_is_absent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def member(group: Any) -> None:
        known = metrics.Perceptual({"vgg": lambda x, y: 0.5}, {}, {"lpips_alex": "no weights"})  # type: ignore[dict-item]
        found = known if group.first else metrics.Perceptual(absent=dict.fromkeys(metrics.NETWORKS, "none on the second machine"))
        monkeypatch.setattr(score, "load_perceptual", lambda *_: found)
        evaluated(tmp_path, group=group)

    assert run_group(2, member) == [0, 0]
    results, per_view = (json.loads((tmp_path / name).read_text()) for name in ("results.json", "per_view.json"))
    assert per_view["day/0.jpg"]["lpips"] == 0.5 and "lpips" not in per_view["day/2.jpg"]
    assert results["lpips"] is None and results["absent"]["lpips"] == "none on the second machine"


def test_scores_are_those_of_the_8_bit_files(tmp_path: Path) -> None:
    """A render with an error of 0.3/255 equals the photograph once it is written, because the rounded values are scored."""
    assert evaluated(tmp_path, rasterize=FakeRasterizer(0.3 / 255))["psnr"] == 100.0
    results = evaluated(tmp_path, rasterize=FakeRasterizer(0.1))
    files = [tmp_path / "test" / "renders" / "day" / "0.png", tmp_path / "test" / "gt" / "day" / "0.png"]
    a, b = (pictures.read_picture(file).astype(np.float64) / 255 for file in files)
    per_view = json.loads((tmp_path / "per_view.json").read_text())
    assert per_view["day/0.jpg"]["psnr"] == pytest.approx(-10 * np.log10(np.mean((a - b) ** 2)), abs=1e-4)
    assert results["psnr"] == pytest.approx(20 * np.log10(255 / 26), abs=1e-4)  # an error of 25.5, rounded up everywhere


def test_absent_lpips_is_null_with_its_reason(tmp_path: Path) -> None:
    results = evaluated(tmp_path)
    assert results["lpips"] is None and results["lpips_alex"] is None
    assert results["absent"]["lpips_3dgs"] == "no weights of LPIPS (vgg): run this"
    assert "--no-lpips" in evaluated(tmp_path, lpips=False)["absent"]["lpips"]


def test_masks_are_respected(tmp_path: Path) -> None:
    mask = torch.zeros(H, W)
    mask[:, :20] = 1.0
    results = evaluated(tmp_path, FakeCapture(mask=mask), FakeRasterizer(0.3, slice(20, None)))  # wrong only where pixels do not count
    assert results["psnr"] == 100.0 and results["ssim"] == pytest.approx(1) and results["masked"]
    assert (pictures.read_picture(tmp_path / "test" / "errors" / "day" / "0.png") == 0).all()
    assert evaluated(tmp_path, FakeCapture(mask=mask), FakeRasterizer(0.3))["psnr"] < 20
    with pytest.raises(InputError, match="masks"):
        evaluated(tmp_path, FakeCapture(mask=torch.zeros(H, W)))


def test_training_views_have_results_of_their_own(tmp_path: Path) -> None:
    held_out = evaluated(tmp_path)
    results = evaluated(tmp_path, views="train")
    assert results["views"] == "train" and (tmp_path / "train" / "renders" / "day" / "3.png").is_file()
    assert json.loads((tmp_path / "results_train.json").read_text()) == results
    assert json.loads((tmp_path / "results.json").read_text()) == held_out


def test_training_views_of_an_earlier_evaluation_are_removed(tmp_path: Path) -> None:
    """An interruption before they are scored again must not leave those of another iteration beside new scores."""
    for name, stays in (("training_views.json", False), ("per_view_train.json", True)):
        (tmp_path / name).write_text("{}")
        evaluated(tmp_path)
        assert (tmp_path / name).exists() == stays


def test_empty_split(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"--split .*--views train"):
        evaluated(tmp_path, FakeCapture(test=()))
    assert not list(tmp_path.iterdir())
    assert evaluated(tmp_path, FakeCapture(test=()), views="train")["view_count"] == 2


def test_pictures_of_an_earlier_split_are_removed(tmp_path: Path) -> None:
    evaluated(tmp_path)
    evaluated(tmp_path, FakeCapture(test=(1,), train=(0, 2, 3)))
    assert [p.name for p in (tmp_path / "test" / "renders").rglob("*.png")] == ["1.png"]


def test_a_strip_shows_one_view_for_each_expert(tmp_path: Path) -> None:
    evaluated(tmp_path, lpips=False)
    folder = tmp_path / "test" / "experts"
    assert [p.name for p in folder.iterdir()] == ["color.png"]
    sheet, drawn = pictures.read_picture(folder / "color.png"), pictures.read_picture(tmp_path / "test" / "renders" / "day" / "0.png")
    assert sheet.shape == (pictures.BAR + H, 3 * W + 2 * pictures.GAP, 3)
    for i in range(3):  # the rasteriser draws the first view for any Gaussians
        assert np.array_equal(sheet[pictures.BAR :, i * (W + pictures.GAP) :][:, :W], drawn)
    pictures.write_picture(folder / "opacity.png", drawn)  # left by an evaluation of another scene
    evaluated(tmp_path, lpips=False)
    evaluated(tmp_path, lpips=False, views="train")
    assert [p.name for p in folder.iterdir()] == ["color.png"] and (tmp_path / "train" / "experts" / "color.png").is_file()
    evaluated(tmp_path, lpips=False, scene=FakeScene(routed=False))
    assert not folder.exists() and (tmp_path / "test" / "renders" / "day" / "0.png").is_file()


def test_photograph_of_another_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FakeCapture, "frame", lambda self, index: SimpleNamespace(rgb=photo(index)[:-1], mask=None))
    with pytest.raises(InputError, match=naming("day/0.jpg", "48 x 36", "48 x 35")):
        evaluated(tmp_path)


def test_lpips_is_scored_if_there_are_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(weights, "load", lambda net, explicit=None: (random_tensors(net), f"{net} from here"))
    results = evaluated(tmp_path)
    assert results["lpips"] > 0 and results["lpips_3dgs"] > 0 and results["lpips_alex"] > 0 and not results["absent"]
    assert results["lpips_weights"] == {"vgg": "vgg from here", "alex": "alex from here"}
    assert metrics.NETWORKS.keys() <= json.loads((tmp_path / "per_view.json").read_text())["day/0.jpg"].keys()
