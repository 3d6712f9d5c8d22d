"""Plans: each run once, named by everything that changes its numbers."""

import importlib
from dataclasses import replace
from pathlib import Path

import pytest

from scene_experts.commands.train import parse_train
from scene_experts.core.errors import InputError
from scene_experts.data.fetch import catalog
from scene_experts.data.images import check_policy, target_size
from scene_experts.data.settings import Data
from scene_experts.reproduce.experiments import DATASETS, EXPERIMENTS
from scene_experts.reproduce.plan import (
    COLLECTIONS,
    OWN,
    CaptureSpec,
    Scale,
    Spec,
    code_of,
    find_own_scenes,
    find_paper_scenes,
    identity,
    list_runs,
    shrink,
)
from scene_experts.scene.anchors.routers import Linear, Margin
from scene_experts.training.config import flags_of
from scene_experts.training.recipes import RECIPES

FOX = CaptureSpec("fox", OWN, Path("captures/fox"))


def test_a_run_that_several_tables_need_is_made_once():
    found = list_runs([EXPERIMENTS["table3"], EXPERIMENTS["table4"]], [FOX], [0, 1], Scale())
    assert len(found) == len(set(found)) == 2 * 6  # scaffold-gs, its opacity form (both tables), four MoE rows
    assert [s.seed for s in found] == [0] * 6 + [1] * 6


def test_the_papers_scenes_serve_the_experiments_that_name_them():
    scenes = [CaptureSpec("truck", "TanksAndTemples", Path("truck")), CaptureSpec("rome", "BungeeNeRF", Path("rome"))]
    assert {s.scene.name for s in list_runs([EXPERIMENTS["table3"]], scenes, [0], Scale())} == {"truck"}


def test_the_arguments_make_the_run_that_the_key_names(tmp_path):
    spec = Spec(replace(FOX, options={"split": "none"}), "moe-gs", 3, Scale.of(0.1))
    made = parse_train(spec.arguments(tmp_path)[1:])
    assert made.cfg == spec.train and made.data == spec.data and made.out == tmp_path
    assert (made.cfg.iterations, made.data.resolution, made.data.split) == (3000, "share:0.1", "none")


def test_what_changes_numbers_changes_the_key_and_the_place_does_not():
    spec = Spec(FOX, "moe-gs", 0, Scale())
    others = [
        replace(spec, seed=1),
        replace(spec, recipe="scaffold-gs"),
        replace(spec, scale=Scale(iterations=7000)),
        replace(spec, scale=Scale(resolution="longest:400")),
        replace(spec, scene=replace(FOX, name="kermit")),
        replace(spec, scene=replace(FOX, options={"normalise": "none"})),
    ]
    assert len({spec.key, *(o.key for o in others)}) == 7
    assert replace(spec, scene=replace(FOX, path=Path("/elsewhere/fox"))).key == spec.key


def test_a_background_that_the_recipe_computes_does_not_change_the_key():
    own, black = RECIPES["one-network"][1], RECIPES["scaffold-gs"][1]
    planned, trained = Data(Path("fox")), Data(Path("fox"), background=(0.5, 0.4, 0.3))
    assert identity("fox", own, planned) == identity("fox", own, trained)
    assert identity("fox", black, planned) != identity("fox", black, trained)


def test_a_setting_counts_where_it_differs_from_its_default_and_a_part_where_it_changed(monkeypatch):
    cfg = Spec(FOX, "moe-gs", 0, Scale()).train
    name = identity("fox", cfg, Data(FOX.path))
    for changed in (
        replace(cfg, average=replace(cfg.average, span=0.25)),
        replace(cfg, growth=replace(cfg.growth, gradient="absolute")),
        replace(cfg, scene=replace(cfg.scene, decoder=replace(cfg.scene.decoder, router=Margin()))),
    ):
        assert identity("fox", changed, Data(FOX.path)) != name
    assert len({identity("fox", cfg, Data(FOX.path, init=start)) for start in ("auto", "dense", "random")} | {name}) == 3
    monkeypatch.setattr(Linear, "changes", ("The logits are divided by two.",))
    assert identity("fox", cfg, Data(FOX.path)) != name
    plain = Spec(FOX, "scaffold-gs", 0, Scale()).train  # has no router
    assert identity("fox", plain, Data(FOX.path)) == Spec(FOX, "scaffold-gs", 0, Scale()).key


def test_scale():
    assert Scale.of(1.0) == Scale()
    assert Scale.of(0.25) == Scale(0.25, None, None) and Spec(FOX, "moe-gs", 0, Scale(0.25)).data.resolution == "share:0.25"
    assert Scale.of(0.25, 3000, "as-is") == Scale(0.25, 3000, "as-is")
    lengths = {r: [Spec(FOX, r, 0, s).train.iterations for s in (Scale(), Scale(0.25), Scale(iterations=3000))] for r in RECIPES}
    assert lengths["moe-gs"] == lengths["3dgs"] == [30_000, 7500, 3000]
    assert lengths["octree-gs"] == lengths["octree-moe-gs"] == [40_000, 10_000, 3000]  # each recipe's own schedule
    for wrong in (0.0, 1.5, float("nan")):
        with pytest.raises(InputError, match="--scale"):
            Scale.of(wrong)
    with pytest.raises(InputError, match="--iterations"):
        Scale.of(1.0, 0)
    with pytest.raises(InputError, match="--resolution"):
        Scale.of(1.0, None, "huge")


def test_a_smaller_scale_is_a_smaller_picture_whatever_the_protocol():
    scales = (1.0, 0.95, 0.5, 0.1)
    for policy, full in (("auto", (4946, 3286)), ("auto", (684, 385)), ("longest:800", (4946, 3286)), ("as-is", (684, 385))):
        sizes = [target_size(check_policy(shrink(policy, s) if s < 1 else policy), full) for s in scales]
        assert all(abs(w - s * sizes[0][0]) <= 1 and abs(h - s * sizes[0][1]) <= 1 for s, (w, h) in zip(scales, sizes)), policy
    # inria:4 reads images_4, which is 1237 px wide of 4946
    assert target_size(check_policy(shrink("inria:4", 0.5)), (4946, 3286))[0] == 618
    assert max(target_size(check_policy(shrink("auto", 0.001)), (684, 385))) == 16


def test_own_captures_need_folders_and_names_of_their_own(tmp_path):
    (tmp_path / "a" / "fox").mkdir(parents=True)
    (tmp_path / "b" / "fox").mkdir(parents=True)
    assert find_own_scenes([tmp_path / "a" / "fox"])[0].name == "fox"
    for name in ("one", "two"):  # as `make` calls them
        (tmp_path / name / "capture").mkdir(parents=True)
    assert [scene.name for scene in find_own_scenes([tmp_path / "one/capture", tmp_path / "two/capture"])] == ["one", "two"]
    with pytest.raises(InputError, match="fox"):
        find_own_scenes([tmp_path / "a" / "fox", tmp_path / "b" / "fox"])
    with pytest.raises(InputError, match="--captures"):
        find_own_scenes([tmp_path / "none"])


def test_the_papers_scenes_are_found_with_their_protocol(tmp_path):
    for name in ("images", "sparse"):
        (tmp_path / "mipnerf360" / "garden" / name).mkdir(parents=True)
    (scene,) = find_paper_scenes(tmp_path)
    assert (scene.name, scene.dataset, scene.options["resolution"]) == ("garden", "MipNeRF360", "inria:4")
    spec = Spec(scene, "moe-gs", 0, Scale())
    made = parse_train(spec.arguments(tmp_path / "run")[1:])
    assert made.data == spec.data and made.data.normalise == "none"
    assert made.cfg == spec.train and made.cfg.scene.voxel_size == 0.001


@pytest.mark.slow
def test_the_papers_scenes_bring_the_numbers_of_their_scripts():
    rome = CaptureSpec("rome", "BungeeNeRF", Path("rome"), {}, catalog.BUNGEENERF.numbers)
    octree = Spec(rome, "octree-gs", 0, Scale()).train.scene.select
    assert (octree.base_layer, octree.visible_threshold, octree.dist_ratio) == (10, 0.0, 0.99)
    moe = Spec(rome, "moe-gs", 0, Scale()).train
    assert (moe.scene.voxel_rule, moe.growth.init_factor) == ("squared_median", 128)
    assert Spec(rome, "3dgs", 0, Scale()).train == RECIPES["3dgs"][1]  # has none of them
    for recipe in RECIPES:
        spec = Spec(rome, recipe, 0, Scale())
        assert parse_train(spec.arguments(Path("run"))[1:]).cfg == spec.train
    for collection in catalog.COLLECTIONS:  # every place is one of a recipe
        for place, _ in collection.numbers:
            assert any(flags_of(cfg, [(place, 0)]) for _, cfg in RECIPES.values()), place


@pytest.mark.parametrize("given", ["--scene.voxel-size 0.02", "--scene.voxel-size=0.02"])
def test_flags_of_a_recipe_have_the_last_word_over_the_numbers_of_a_scene(given):
    truck = CaptureSpec("truck", "TanksAndTemples", Path("truck"), {}, catalog.TANDT.numbers)
    spec = Spec(truck, f"scaffold-gs {given}", 0, Scale())
    made = parse_train(spec.arguments(Path("run"))[1:]).cfg
    assert made.scene.voxel_size == spec.train.scene.voxel_size == 0.02
    assert replace(made, recipe="") == replace(spec.train, recipe="")


def test_the_catalog_and_the_experiments_know_the_same_scenes():
    assert {s.name: COLLECTIONS[s.collection.key] for s in catalog.SCENES} == {s: d for d, scenes in DATASETS.items() for s in scenes}


def test_code_of_another_package_counts(tmp_path, monkeypatch):
    module = tmp_path / "foreign_package.py"
    text = (
        "from dataclasses import dataclass\nfrom scene_experts.training.losses import Weights\n"
        "@dataclass(frozen=True)\nclass Foreign(Weights):\n    pass\n"
    )
    module.write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    foreign = importlib.import_module("foreign_package")
    ours = Spec(FOX, "moe-gs", 0, Scale()).train
    cfg = replace(ours, loss=foreign.Foreign())
    first = code_of(cfg)
    assert code_of(ours) == "" and len(first) == 12
    module.write_text(text + "# changed\n")
    assert code_of(cfg) != first
    for name in ("beside", "numpy"):
        (tmp_path / name).mkdir()
    files = {"helper.py": "import beside.deep, foreign_package, numpy\n", "beside/__init__.py": "", "beside/deep.py": "", "other.py": ""}
    files |= {"numpy/__init__.py": "", "broken.py": "def"}  # of another distribution, and of nobody who can run it
    for name, content in files.items():
        (tmp_path / name).write_text(content)
    module.write_text(text + "def later():\n    from helper import x\n    import broken\n")
    found = code_of(cfg)
    for name, counts in (
        ("helper.py", True),
        ("beside/deep.py", True),
        ("other.py", False),
        ("numpy/__init__.py", False),
        ("broken.py", True),
    ):
        (tmp_path / name).write_text(files[name] + "# changed\n")
        assert (code_of(cfg) != found) == counts, name
        found = code_of(cfg)
    assert identity("fox", ours, Data(FOX.path), first) != identity("fox", ours, Data(FOX.path))
