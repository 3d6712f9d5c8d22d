"""What results.json states, and when two results may be compared."""

from __future__ import annotations

import pytest

from scene_experts.core.errors import InputError
from scene_experts.core.io import write_json
from scene_experts.evaluate.metrics import VARIANTS, Perceptual
from scene_experts.evaluate.options import EvalOptions
from scene_experts.evaluate.results import (
    check_protocol,
    describe_failed,
    describe_scores,
    describe_size,
    describe_views,
    find_difference,
    find_failed,
    find_outdated,
    load_results,
)
from support.captures import load
from support.messages import naming
from support.scenes import start_scene
from support.synthetic import make_blender, make_capture


@pytest.mark.parametrize(("recipe", "row"), [("scaffold-gs", 316), ("3dgs", 248)])
def test_sizes_are_those_of_the_published_layouts(recipe: str, row: int) -> None:
    scene = start_scene(recipe)
    size, networks = describe_size(scene), sum(4 * t.numel() for t in scene.network_tensors().values())
    assert size["ply_bytes"] == row * len(scene.table) and size["network_bytes"] == networks
    assert size["total_bytes"] == row * len(scene.table) + networks
    assert size["MB"] == size["total_bytes"] / 1e6 and size["MiB"] == size["total_bytes"] / 2**20


def test_runs_trained_after_they_were_scored_are_reported(tmp_path):
    for step in (231, 400):
        (tmp_path / "checkpoints").mkdir(exist_ok=True)
        (tmp_path / "checkpoints" / f"ckpt_{step:06d}.safetensors").touch()
    found = find_outdated(["moe-gs", "other"], [tmp_path, tmp_path / "none"], [{"step": 231}, {"step": 5}])
    assert len(found) == 1 and all(fact in found[0] for fact in ("moe-gs", "231", "400", f"eval {tmp_path}"))
    assert find_outdated(["moe-gs"], [tmp_path], [{"step": 400}]) == find_outdated(["moe-gs"], [tmp_path], [{}]) == []


def test_means_are_over_the_views_that_have_a_score():
    view = {"psnr": 20.0, "ssim": 0.5, "masked": False, "detail": 0.8, "sharpness": 0.1, "sharpness_photo": 0.2}
    found = describe_scores({"a": view, "b": {**view, "psnr": 30.0, "detail": None}, "hidden": {}}, Perceptual.off())
    assert found["psnr"] == 25.0 and found["sharpness"]["ratio"] == 0.5 and found["detail"] == 0.8 and not found["masked"]
    assert found["lpips"] is None and "--no-lpips" in found["absent"]["lpips"]
    assert found["variants"] == VARIANTS
    masked = describe_scores({"a": {**view, "masked": True}}, Perceptual.off())["variants"]
    assert "over the pixels that the mask counts" in masked["psnr"] and all("of masked views" in about for about in masked.values())
    with pytest.raises(InputError, match="masks"):
        describe_scores({"hidden": {}}, Perceptual.off())


def test_the_first_difference_in_the_protocol_is_named():
    one, two = {"split": "mod8", "view_count": 9}, {"split": "mod4", "view_count": 9}
    assert find_difference(["a", "b"], [one, {**one, "appearance": "rule"}]) is None
    assert find_difference(["a", "b"], [one, two]) == ("the same split, found mod8 in a and mod4 in b", "--split")
    with pytest.raises(InputError, match=naming("--split", "--mixed")):
        check_protocol(["a", "b"], [one, two])
    words = "the same alignment of held-out cameras, found none in a and done in b"
    assert find_difference(["a", "b"], [one, {**one, "alignment": "done"}]) == (words, "--align-poses")
    one, two = {**one, "mean_pixels": 1536}, {**two, "mean_pixels": 1504}  # views of several sizes
    assert find_difference(["a", "b"], [one, two]) == ("the same split, found mod8 in a and mod4 in b", "--split")
    assert find_difference(["a", "b"], [one, {**one, "mean_pixels": 1504}]) == (
        "the same picture size, found 1536 in a and 1504 in b",
        "--resolution",
    )


@pytest.mark.parametrize("key, option", [("scored", "--split"), ("photographs", "--data")])
def test_runs_of_other_photographs_with_the_same_count_are_not_compared(key, option):
    one = {"capture": "fern", "split": "files", "view_count": 3}
    check_protocol(["a", "b"], [one, {**one, key: "0123"}])  # an older file does not say
    with pytest.raises(InputError, match=naming(option, "photographs")):
        check_protocol(["a", "b"], [{**one, key: "0123"}, {**one, key: "4567"}])


def test_runs_without_the_same_photographs_are_not_compared():
    one = {"capture": "fox"}
    check_protocol(["a", "b"], [one, {**one, "left_out": []}])
    with pytest.raises(InputError, match=naming("photographs left out", "b.png", "--leave-out")):
        check_protocol(["a", "b"], [one, {**one, "left_out": ["b.png"]}])


def test_photographs_over_other_backgrounds_are_not_compared():
    old = {"split": "mod8"}
    white, black = ({**old, "background": [value] * 3} for value in (1.0, 0.0))
    assert find_difference(["a", "b", "c"], [old, white, white]) is None
    for runs in ([white, black], [old, white, black]):
        with pytest.raises(InputError, match=naming("--background", [1.0] * 3, [0.0] * 3)):
            check_protocol("abc", runs)


def test_captures_of_one_name_with_other_poses_are_not_compared():
    old = {"capture": "scene", "split": "mod8"}
    one, two = ({**old, "poses": f"{x} 0 0 1 0 0 0 1 0; 0 1 0 1 0 0 0 1 0"} for x in (1.0, 2.0))
    assert find_difference("abc", [old, one, one]) is None
    assert find_difference("abc", [old, one, two]) == ("the same camera poses, found others in c than in b", "--data")


def test_the_background_is_stated_where_photographs_are_transparent(tmp_path):
    opaque = make_capture(tmp_path / "colmap", views=3, size=(16, 12), points=20).folder
    make_blender(tmp_path / "blender", views=3, size=16)
    blue = (0.0, 0.0, 1.0)
    for folder, colour, stated in ((tmp_path / "blender", None, [1.0] * 3), (tmp_path / "blender", blue, [*blue]), (opaque, blue, None)):
        capture = load(folder, background=colour)
        assert describe_views(capture, [view.camera for view in capture.views], EvalOptions()).get("background") == stated
        capture.images.close()


def test_views_that_fail_are_named():
    scores = {"a": 20.0, "b": 8.0, "c": 21.0, "d": 19.0}
    views = {name: {"file": f"{name}.png", "psnr": psnr} for name, psnr in scores.items()}
    assert find_failed(views) == ["b"] and find_failed({"a": {"file": "a.png"}}) == []
    text = describe_failed(views)
    assert "1 of 4" in text and "b (8.0 dB)" in text and "20.0 dB" in text
    assert describe_failed({name: views[name] for name in "acd"}) == ""
    assert find_failed({name: views[name] for name in "ab"}) == ["b"]  # also of two views


def test_a_run_that_holds_nothing_out_has_the_scores_of_its_training_views_where_they_do(tmp_path):
    run = tmp_path / "my run"
    run.mkdir()
    with pytest.raises(InputError, match="'"):  # the command is quoted
        load_results(run)
    write_json(run / "results_train.json", {"psnr": 33.0, "step": 100})
    assert load_results(run, training=True)["psnr"] == 33.0
    with pytest.raises(InputError):  # not those of held-out views
        load_results(run)
    write_json(run / "results.json", {"psnr": 27.0, "step": 100})
    assert load_results(run, training=True)["psnr"] == 27.0
