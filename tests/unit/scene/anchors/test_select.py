import json
from dataclasses import replace

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.fields import check_fields
from scene_experts.core.table import Table
from scene_experts.core.types import Camera, Decoded, Gaussians, Mode, Points
from scene_experts.scene.anchors.levels import MOST_FORK, MOST_LEVELS, Levels
from scene_experts.scene.anchors.select import AllAnchors, LevelSelector, Octree, fade_opacities, visible_rows
from scene_experts.training.recipes import RECIPES
from support.messages import naming
from support.octree import camera_at, slow_level

CAMERA = Camera(torch.eye(4), torch.eye(3), 4, 4)
LEVELS = Levels(4, 1, 2, 0.8, (-1.0, -1.0, -1.0), 8.0, "round", 0.0, ((0.0, 0.0, 0.0),))


def table(n=60, seed=0) -> Table:
    torch.manual_seed(seed)
    facts = {"xyz": torch.rand(n, 3) * 4, "level": torch.randint(0, 4, (n,)), "extra_level": torch.rand(n)}
    return Table({"a": torch.zeros(n, 1)}, facts)


def test_all_anchors_then_the_visibility_filter():
    xyz = torch.arange(12.0).reshape(4, 3)
    table = Table({"a": torch.zeros(4, 1)}, {"xyz": xyz})
    even = lambda means, scales, camera: means[:, 0] % 2 == 0  # noqa: E731
    assert AllAnchors()(table, CAMERA, 1, True) is None
    assert visible_rows(None, xyz, xyz, CAMERA, even).tolist() == [0, 2]


def test_a_selection_is_filtered_and_keeps_row_numbers():
    xyz = torch.arange(12.0).reshape(4, 3)
    even = lambda means, scales, camera: means[:, 0] % 2 == 0  # noqa: E731
    assert visible_rows(torch.tensor([1, 2, 3]), xyz, xyz, CAMERA, even).tolist() == [2]
    assert visible_rows(torch.tensor([], dtype=torch.long), xyz, xyz, CAMERA, even).tolist() == []


@pytest.mark.parametrize("step", [1, 7001, 10_001])
def test_anchors_of_a_level_are_used_where_their_distance_asks_for_it(step):
    rows, at = table(), (0.5, 0.2, -1.0)
    select = LevelSelector(Octree(), LEVELS)
    for mode in Mode:
        top = 4 if mode is Mode.DRAW else {1: 2, 7001: 3, 10_001: 4}[step]
        expected = []
        for i in range(60):
            real = slow_level(rows.facts["xyz"][i].tolist(), int(rows.facts["level"][i]), at) + float(rows.facts["extra_level"][i])
            if int(rows.facts["level"][i]) <= min(max(round(real), 0), top - 1):
                expected.append(i)
        assert select(rows, camera_at(*at), step, mode).tolist() == expected
        assert select.top(step, mode) == top


def test_levels_are_let_in_one_by_one():
    turns = Octree().turns(LEVELS)  # two finer levels: 1 : 2/3 of 10,000
    assert turns == pytest.approx([6000, 10_000])
    first = 10_000 * (1 - 1 / 1.5) / (1 - (1 / 1.5) ** 3)
    assert Octree().turns(replace(LEVELS, count=5))[0] == pytest.approx(first)
    assert Octree(first=3).turns(replace(LEVELS, first=3)) == []
    select = LevelSelector(Octree(), LEVELS)
    assert select.coarse(10_000) and not select.coarse(10_001)
    assert not LevelSelector(Octree(coarse_until=0), LEVELS).coarse(1)
    assert LevelSelector(Octree(coarse_until=0), LEVELS).top(1, Mode.TRAIN) == 4
    assert Octree().scaled(0.1).coarse_until == 1000


def test_a_viewer_may_hold_the_level():
    rows, select = table(), LevelSelector(Octree(), LEVELS)
    near = camera_at(2.0, 2.0, 2.0)
    capped = select.with_cap(1)(rows, near, 20_000, Mode.DRAW)
    assert (rows.facts["level"][capped] <= 1).all() and len(capped) == int((rows.facts["level"] <= 1).sum())
    assert torch.equal(select.with_cap(1).with_cap(None)(rows, near, 20_000, Mode.DRAW), select(rows, near, 20_000, Mode.DRAW))
    assert len(select.with_cap(0)(rows, near, 20_000, Mode.DRAW)) == int((rows.facts["level"] == 0).sum())


def test_blending_fades_the_finest_level_in():
    rows, at = table(), (0.5, 0.2, -1.0)
    select = LevelSelector(Octree(rule="blend"), replace(LEVELS, rule="blend"))
    chosen = select(rows, camera_at(*at), 20_000, Mode.DRAW)
    fade = select.fade(rows, chosen, camera_at(*at), 20_000, Mode.DRAW)
    for i, row in enumerate(chosen.tolist()):
        level = int(rows.facts["level"][row])
        real = slow_level(rows.facts["xyz"][row].tolist(), level, at) + float(rows.facts["extra_level"][row]) + 1
        real = min(max(real, 0.9999), 3.9999)
        assert level <= int(real)
        assert float(fade[i]) == pytest.approx(real - int(real) if level == int(real) else 1.0, abs=1e-4)
    assert ((fade > 0) & (fade < 1)).any() and (fade == 1).any()
    assert LevelSelector(Octree(), LEVELS).fade(rows, chosen, camera_at(*at), 20_000, Mode.DRAW) is None


def test_fading_scales_raw_and_drawn_opacities():
    g = Gaussians(*(torch.zeros(3, c) for c in (3, 4, 3)), torch.tensor([0.5, 0.25, 1.0]), torch.zeros(3, 3), torch.tensor([4, 5, 8]))
    decoded = Decoded(g, torch.tensor([2, 4]), torch.tensor([[0.5, 0.25], [1.0, -1.0]]), {})
    out = fade_opacities(decoded, torch.tensor([0.5, 0.1]), rows=6, K=2)
    torch.testing.assert_close(out.gaussians.opacities, torch.tensor([0.25, 0.125, 0.1]))
    torch.testing.assert_close(out.raw_opacity, torch.tensor([[0.25, 0.125], [0.1, -0.1]]))
    assert fade_opacities(decoded, None, 6, 2) is decoded


XYZ = torch.rand(300, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * torch.tensor([2.0, 2, 8])
CAMERAS = [camera_at(1.0, 1.0, z) for z in (-2.0, -1.0, 0.0, 2.0, 3.0, 6.0)]


def start(**changes):
    return Octree(**changes).begin(XYZ, 0.05, CAMERAS)


def test_a_scene_begins_with_the_occupied_cells_of_every_level_weeded():
    facts, finest, select = start()
    levels = select.lattices
    assert levels.count == round(torch.log2(torch.tensor(levels.standard / quantile_near())).item()) + 1 > 3
    assert finest == pytest.approx(levels.edge / 2 ** (levels.count - 1)) and levels.first == levels.count // 2
    middle = levels.size(levels.count // 2 - 1)
    assert 0.2 / 2**0.5 <= middle <= 0.2 * 2**0.5  # four voxels, to the next power of two of the cube
    share = levels.share(facts["xyz"].float(), facts["level"])
    assert (share > levels.threshold).all() and 0 < levels.threshold < 1
    torch.testing.assert_close(
        facts["xyz"], torch.stack([levels.positions(c[None], int(j))[0] for c, j in zip(facts["cell"], facts["level"])])
    )
    everyone = Octree(visible_threshold=0.0).begin(XYZ, 0.05, CAMERAS)[0]
    all_shares = levels.share(everyone["xyz"].float(), everyone["level"])
    assert len(everyone["level"]) > len(facts["level"]) and (all_shares > 0).all()


def quantile_near() -> float:
    per_camera = [(XYZ - c.position.double()).norm(dim=1) for c in CAMERAS]
    ends = [torch.quantile(d, q) for d in per_camera for q in (0.999, 0.001)]
    return float(torch.quantile(torch.stack(ends), 0.001))


def test_what_the_files_of_the_reference_set():
    _, _, select = start(base_layer=3, count=2, first=1, visible_threshold=0.9)
    low, high = float(XYZ.min()), float(XYZ.max())
    assert select.lattices.edge == pytest.approx(1.1 * (high - low) / 8) and select.lattices.count == 2
    assert select.lattices.threshold == 0.9 and select.lattices.origin[0] == pytest.approx((low + high) / 2 - 0.55 * (high - low))


def test_one_level_keeps_its_anchors():
    facts, _, select = start(count=1)
    assert select.lattices.first == 0 and len(facts["cell"]) > 100


def test_newborn_anchors_have_the_facts_and_checkpoints_the_levels():
    facts, _, select = start()
    born = select.places(torch.tensor([[3, 2, 1]]), 0.0, 2)
    assert born.keys() == facts.keys() and born["level"].tolist() == [2] and born["extra_level"].tolist() == [0.0]
    torch.testing.assert_close(born["xyz"], select.lattices.positions(torch.tensor([[3, 2, 1]]), 2))
    assert Octree().restore(json.loads(json.dumps(select.meta()))) == select
    assert AllAnchors().meta() == {} and AllAnchors().restore({}) == AllAnchors()


def test_impossible_numbers_are_refused():
    check_fields(Octree(), "scene.select")
    impossible = {
        "fork": 1,
        "count": -1,
        "dist_ratio": 0.5,
        "visible_threshold": 1.0,
        "coarseness": 0.0,
        "coarse_factor": 0.0,
        "extend": 0.9,
    }
    for name, value in impossible.items():
        with pytest.raises(InputError, match=naming(f"--scene.select.{name.replace('_', '-')}", value)):
            check_fields(Octree(**{name: value}), "scene.select")
    check_fields(Octree(fork=MOST_FORK, count=MOST_LEVELS), "scene.select")
    for name, most in (("fork", MOST_FORK), ("count", MOST_LEVELS)):  # more of them could be trained, but no checkpoint of it could be read
        with pytest.raises(InputError, match=naming(f"--scene.select.{name}", f"{most:,}", most + 1)):
            check_fields(Octree(**{name: most + 1}), "scene.select")
    assert start(base_layer=19)[2].lattices.count == 1
    for layer in (20, 1000):
        with pytest.raises(InputError, match=naming(f"2^{layer}", "--scene.select.base-layer")):
            start(base_layer=layer)
    points = Points(torch.rand(9, 3, dtype=torch.float64), torch.zeros(9, 3, dtype=torch.uint8))
    with pytest.raises(InputError, match="--split"):
        RECIPES["octree-gs"][1].scene.start(points, 5.0)
