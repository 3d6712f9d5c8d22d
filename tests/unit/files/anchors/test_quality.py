"""The search for a precision, and files of a wanted loss or size."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.plain import to_json
from scene_experts.data.views import World
from scene_experts.files import placed
from scene_experts.files.anchors import compact, quality
from scene_experts.files.anchors.precision import from_spread
from scene_experts.files.anchors.quality import search, with_learned
from scene_experts.files.anchors.rounding import rounded
from scene_experts.files.anchors.write import contents, describe
from scene_experts.files.codec import fit
from scene_experts.files.export import export
from scene_experts.files.lone import open_scene
from scene_experts.files.options import Options
from support.files import run_in_memory


@pytest.mark.parametrize("start", [-60.0, -40.0, 0.0])
def test_the_search_ends_near_the_wanted_value(start):
    tried = []

    def value(u):
        tried.append(u)
        return 0.3 * 2.0 ** (1.3 * (u + 31))

    found = search(value, 0.1, start, 1.0, 0.85)
    assert 0.085 <= value(found) <= 0.1 and len(tried) <= quality.ROUNDS + 1


def test_steps_and_functions_without_a_place():
    assert search(lambda u: 5.0, 0.1, 0.0, 1.0, 0.85) is None
    found = search(lambda u: 0.0 if u < -3 else 1.0, 0.5, 0.0, 1.0, 0.85)
    assert -4 < found < -3
    tried = []
    assert search(lambda u: tried.append(u) or 0.0, 0.5, -10.0, 1.0, 0.85) == quality.COARSEST and max(tried) == quality.COARSEST
    assert search(lambda u: 2.0**u, 1e-30, -50.0, 1.0, 0.85) is None
    assert math.isfinite(search(lambda u: -1.0, 0.5, 0.0, 1.0, 0.85))


def test_the_search_finds_a_place_where_the_function_hardly_changes():
    value = lambda u: 80 + 2 ** (u / 4)  # noqa: E731
    found = search(value, 80.1, 38.0, 0.12, 0.98, 0.0, 60.0)
    assert found is None  # the least place has 81
    found = search(value, 81.5, 38.0, 0.12, 0.9999, 0.0, 60.0)
    assert found is not None and 81.3 < value(found) <= 81.5


@pytest.mark.parametrize("slope", [0.04, 0.05, 0.06])
def test_the_search_comes_near_from_above(slope):
    value = lambda u: 1.3 * 2 ** (slope * (u - 38))  # noqa: E731
    assert 0.98 <= value(search(value, 1.0, 38.0, 0.12, 0.98, 0.0, 60.0)) <= 1


@pytest.mark.slow
def test_a_file_without_photographs_gets_a_wanted_loss_or_size(tmp_path, monkeypatch):
    monkeypatch.setattr(placed, "SIZE", (80, 60))
    monkeypatch.setattr(quality, "VIEWS", 3)
    monkeypatch.setattr(fit, "STEPS", 20)
    run = run_in_memory("scaffold-gs")
    with torch.no_grad():
        for name, value in run.scene.table.params.items():
            value += 0.2 * torch.randn(value.shape, generator=torch.Generator().manual_seed(len(name)))
    about = describe(run, World()) | {"train": to_json(run.config.train)}
    compact.write(tmp_path / "a.compact", contents(run, World(), about), {})
    opened = open_scene(tmp_path / "a.compact")
    for loss in (0.01, 1.0):  # cameras around a scene say too little
        (written,) = export(opened, "compact", tmp_path / "kept.compact", Options(measure=False, quality=loss))
        assert written.lines[-1] == quality.UNJUDGED
    monkeypatch.setattr(quality, "AROUND", "as if the cameras were those of the photographs")
    sizes = []
    for loss in (0.01, 1.0):
        (written,) = export(opened, "compact", tmp_path / f"{loss}.compact", Options(measure=False, quality=loss))
        sizes.append(written.bytes)
        assert "estimated, without photographs" in written.lines[-1]
    assert sizes[1] < 0.9 * sizes[0]
    wanted = 0.5 * sum(sizes) / 1e6
    (written,) = export(opened, "compact", tmp_path / "b.compact", Options(measure=False, target_mb=wanted))
    assert written.bytes <= wanted * 1e6 and written.bytes > 0.9 * wanted * 1e6
    (written,) = export(opened, "compact", tmp_path / "d.compact", Options(measure=False, target_mb=1000.0))
    assert "lose 0.000 dB" in written.lines[-1]
    with pytest.raises(InputError, match=r"--target-mb .*the smallest file has 0\.\d+ MB"):
        export(opened, "compact", tmp_path / "c.compact", Options(measure=False, target_mb=0.0001))


def test_views_that_judge_are_not_those_without_a_pixel_that_counts(monkeypatch):
    masks, looked = {2: torch.zeros(2, 2), 4: torch.ones(2, 2)}, []

    def frame(index):
        looked.append(index)
        return SimpleNamespace(mask=masks.get(index))

    capture = SimpleNamespace(train=tuple(range(8)), images=range(8), frame=frame)
    monkeypatch.setattr(quality, "VIEWS", 4)
    assert quality.Judge(None, None, capture, None).views == [0, 4, 6] and looked == [0, 2, 4, 6]
    masks.update({i: torch.zeros(2, 2) for i in (0, 2, 4, 6)})
    assert quality.Judge(None, None, capture, None).views == [1]


def test_a_file_of_a_trained_rate_loses_nothing_at_rounding():
    run = run_in_memory("scene-experts")
    g, scene = torch.Generator().manual_seed(0), run.scene
    with torch.no_grad():
        for value in scene.table.params.values():
            value += 0.3 * torch.randn(value.shape, generator=g)
    scene.start_rounding(0.01 + 0.1 * torch.rand(68, generator=g), torch.randint(-2, 5, (len(scene.table),), generator=g), 0.3)
    scene.table.params["keep"].data.normal_(generator=g)
    run, world = replace(run, scene=scene.settled()), World(0.3, (1.0, 2.0, 3.0))
    data = contents(run, world, describe(run, world))
    assert "steps" not in describe(run, world)["scene"]
    spread = from_spread(data.columns, data.networks)
    assert not with_learned(spread, run_in_memory("scene-experts").scene).learned
    precision = with_learned(spread, run.scene)
    assert precision.learned and precision.at(4.0).steps == precision.steps
    assert torch.equal(precision.at(4.0).networks["cov.experts.w1"], spread.networks["cov.experts.w1"] + 2)
    found = rounded(data, precision).columns
    slots = data.columns["slots"]
    assert torch.equal(found["feature"], data.columns["feature"]) and torch.equal(found["slots"], slots)
    assert torch.equal(found["offsets"], data.columns["offsets"] * slots[..., None])
    torch.testing.assert_close(found["log_scaling"], data.columns["log_scaling"], rtol=0, atol=1e-6)
