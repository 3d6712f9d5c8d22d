"""Features and matches of photographs: files, threads, masks, interrupted calls."""

import numpy as np
import pytest
import torch
from PIL import Image

from scene_experts.sfm.learned import photographs
from scene_experts.sfm.learned.aliked import Aliked, tensor_shapes
from scene_experts.sfm.learned.lightglue import LightGlue
from scene_experts.sfm.learned.lightglue import tensor_shapes as matcher_shapes
from scene_experts.sfm.learned.photographs import Shots, find_features, find_matches, read_features, write_for_colmap
from scene_experts.sfm.learned.weights import find_weights, load_networks
from support.learned import random_tensors
from support.places import DEMO

FINDER, MATCHER = Aliked(random_tensors(tensor_shapes())), LightGlue(random_tensors(matcher_shapes()))
PAIRS = [(0, 1), (0, 2), (1, 2)]


def write_noise(folder, count=3, size=(96, 64)):
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(count):
        pixels = np.random.default_rng(i).integers(0, 256, (size[1] // 4, size[0] // 4, 3), np.uint8)
        Image.fromarray(pixels).resize(size, Image.Resampling.BICUBIC).save(folder / f"{i}.png")
    return [f"{i}.png" for i in range(count)]


def shots(tmp_path, name="work", threads=1, masks=None, max_side=64):
    return Shots(write_noise(tmp_path / "images"), tmp_path / "images", masks, tmp_path / name, max_side, threads)


@pytest.fixture(autouse=True)
def few(monkeypatch):
    monkeypatch.setattr(photographs, "MOST", 24)


def test_results_are_the_same_at_any_number_of_threads_and_after_an_interruption(tmp_path):
    steps, before = [], torch.get_num_threads()
    for name, threads in (("one", 1), ("three", 3)):
        there = shots(tmp_path, name, threads)
        find_features(there, FINDER, lambda *a: steps.append(a))
        find_matches(there, PAIRS[:2], MATCHER, lambda *a: steps.append(a))
        write_for_colmap(there, PAIRS[:2], tmp_path / f"{name}.npz")
    one, three = np.load(tmp_path / "one.npz"), np.load(tmp_path / "three.npz")
    assert one.files == three.files and all(np.array_equal(one[key], three[key]) for key in one.files)
    assert torch.get_num_threads() == before and ("learned features", 3, 3) in steps and ("learned matches", 2, 2) in steps
    assert one["k0"].dtype == np.float32 and 5 < len(one["k0"]) <= 24 and one["pairs"].shape[1] == 2
    there.matches(0, 1).unlink()
    steps.clear()
    find_features(there, None, lambda *a: steps.append(a))  # type: ignore[arg-type]  # all are there: the network is not needed
    find_matches(there, PAIRS[:2], MATCHER, lambda *a: steps.append(a))
    assert steps == [("learned features", 3, 3), ("learned matches", 1, 2), ("learned matches", 2, 2)]


def test_places_are_in_pixels_of_the_whole_photograph(tmp_path):
    there = shots(tmp_path)
    find_features(there, FINDER, lambda *_: None)
    found = read_features(there, 0)
    assert found.size == (96, 64) and found.places[:, 0].max() > 64 and (found.places >= 0).all()
    assert (found.places <= torch.tensor([96.0, 64.0])).all()


def test_nothing_is_found_behind_a_mask(tmp_path):
    names, masks = write_noise(tmp_path / "images"), tmp_path / "masks"
    masks.mkdir()
    half = np.zeros((64, 96), np.uint8)
    half[:, 48:] = 255
    for name in names:
        Image.fromarray(half).save(masks / f"{name}.png")
    there = shots(tmp_path, masks=masks, max_side=96)
    find_features(there, FINDER, lambda *_: None)
    found = read_features(there, 1).places
    assert len(found) and found[:, 0].min() > 46


def test_the_first_failure_ends_all_and_small_or_grey_photographs_do_not_fail(tmp_path):
    there = shots(tmp_path)
    (tmp_path / "images" / "1.png").write_bytes(b"broken")
    with pytest.raises(Exception, match=r"1\.png"):
        find_features(there, FINDER, lambda *_: None)
    Image.new("L", (3, 2)).save(tmp_path / "images" / "1.png")
    find_features(there, FINDER, lambda *_: None)
    find_matches(there, PAIRS, MATCHER, lambda *_: None)
    assert not len(read_features(there, 1).places)
    write_for_colmap(there, PAIRS, tmp_path / "all.npz")
    assert all(1 not in pair for pair in np.load(tmp_path / "all.npz")["pairs"].tolist())


@pytest.mark.slow
def test_published_weights_match_two_photographs_of_one_scene(tmp_path, monkeypatch):
    """By an affine map that is known: the second photograph is the first, shrunk and shifted."""
    if find_weights() is None:
        pytest.skip("the weights of ALIKED and LightGlue are not installed")
    monkeypatch.setattr(photographs, "MOST", 256)
    (tmp_path / "images").mkdir()
    with Image.open(DEMO / "buddha" / "images" / "008.jpg") as picture:
        first = picture.convert("RGB").resize((480, 320))
    second = Image.new("RGB", (480, 320))
    second.paste(first.resize((384, 256), Image.Resampling.LANCZOS), (60, 40))
    for i, picture in enumerate((first, second)):
        picture.save(tmp_path / "images" / f"{i}.png")
    there = Shots(["0.png", "1.png"], tmp_path / "images", None, tmp_path / "work", 480, 1)
    finder, matcher = load_networks()
    find_features(there, finder, lambda *_: None)
    find_matches(there, [(0, 1)], matcher, lambda *_: None)
    write_for_colmap(there, [(0, 1)], tmp_path / "all.npz")
    found = np.load(tmp_path / "all.npz")
    one, other = found["k0"][found["m0"][:, 0]], found["k1"][found["m0"][:, 1]]
    off = np.linalg.norm(0.8 * one + np.array([60, 40]) - other, axis=1)
    assert len(off) > 100 and np.median(off) < 1 and np.mean(off < 3) > 0.9
