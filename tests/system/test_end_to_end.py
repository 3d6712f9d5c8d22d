"""The whole path, from a capture's files to scored pictures, by the two commands a person types.

On the shipped brighton, and on a coloured capture made in code whose views differ in size and whose principal points are off centre: what
is shipped is centred, so it alone would hide a swapped channel or an ignored principal point.
"""

from __future__ import annotations

import json
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scene_experts import cli
from support.places import DEMO
from support.synthetic import Synthetic, make_capture

BRIGHTON = DEMO / "brighton"


def scored(out: Path, *more: str) -> dict:
    assert cli.main(["eval", str(out), "--no-lpips", *more]) == 0
    return json.loads((out / "results.json").read_text())


@pytest.mark.parametrize("recipe", ["scaffold-gs", "moe-gs"])
@pytest.mark.slow
def test_brighton_from_photographs_to_scores(recipe, tmp_path):
    args = ["train", recipe, "--data", str(BRIGHTON), "--resolution", "factor:2", "--out", str(tmp_path)]
    assert cli.main([*args, "--iterations", "200", "--save-every", "100", "--preview-every", "0"]) == 0
    before, after = scored(tmp_path, "--step", "100"), scored(tmp_path)
    assert (before["step"], after["step"], after["recipe"], after["views"], after["split"]) == (100, 200, recipe, "test", "mod8")
    assert after["psnr"] > before["psnr"] + 0.5 and after["ssim"] > before["ssim"] and 13 < after["psnr"] < 25 and 0.35 < after["ssim"] < 1
    assert after["lpips"] is None and "lpips" in after["absent"]
    assert after["gaussians"] == 10 * after["anchors"] > 1000 and 0 < after["activation_ratio"] < 1
    assert after["size"]["total_bytes"] == 316 * after["anchors"] + after["size"]["network_bytes"]
    assert set(after["experts"]) == (set() if recipe == "scaffold-gs" else {"opacity", "cov", "color"})
    per_view = json.loads((tmp_path / "per_view.json").read_text())
    assert len(per_view) == after["view_count"] and np.mean([v["psnr"] for v in per_view.values()]) == pytest.approx(after["psnr"])
    for kind in ("renders", "gt", "errors", "side_by_side"):
        assert len(list((tmp_path / "test" / kind).iterdir())) == after["view_count"]
    assert {path.stem for path in (tmp_path / "test" / "experts").glob("*.png")} == set(after["experts"])
    losses = [
        sum(row["terms"].values()) for row in map(json.loads, (tmp_path / "metrics.jsonl").read_text().splitlines()) if "terms" in row
    ]
    assert np.mean(losses[-4:]) < 0.8 * np.mean(losses[:2])


@pytest.fixture(scope="module")
def coloured(tmp_path_factory) -> Synthetic:
    return make_capture(tmp_path_factory.mktemp("coloured"), views=24)


def renders(made: Synthetic, out: Path, *more: str) -> dict[str, np.ndarray]:
    """Held-out views of a short training, as the files that `eval` leaves."""
    args = ["train", "moe-gs", "--data", str(made.folder), "--out", str(out), "--iterations", "300", "--preview-every", "0"]
    assert cli.main([*args, *more]) == 0
    scored(out)
    return {path.name: np.asarray(Image.open(path)) for path in sorted((out / "test" / "renders").iterdir())}


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((a.astype(float) - b.astype(float)) ** 2) / 255**2))


@pytest.mark.slow
def test_colours_sizes_and_principal_points(coloured, tmp_path):
    """Scored here, against the pixels that were ray-cast, by nothing of the package."""
    drawn = renders(coloured, tmp_path / "good")
    truth = {name: coloured.images[name] for name in drawn}
    assert len({picture.shape for picture in truth.values()}) == 3, "each size is held out once"
    for name, picture in drawn.items():
        assert picture.shape == truth[name].shape
        good = psnr(picture, truth[name])
        assert good > 23, (name, good)
        for order in list(permutations(range(3)))[1:]:
            assert psnr(picture[..., order], truth[name]) < good - 5, "channels are in order"
        for shift in ((0, 1), (1, 0), (0, -1), (-1, 0)):
            assert psnr(np.roll(picture, shift, (0, 1)), truth[name]) < good, "no pixel off to any side"
    blind = renders(coloured, tmp_path / "blind", "--ignore-principal-point")
    worse = [psnr(drawn[name], truth[name]) - psnr(blind[name], truth[name]) for name in drawn]
    assert min(worse) > 8, worse
