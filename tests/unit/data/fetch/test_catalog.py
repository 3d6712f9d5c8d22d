"""The catalog: each scene of the paper once, with addresses and a protocol that the loader accepts."""

from __future__ import annotations

import re
from importlib.resources import files
from pathlib import Path

import pytest

from scene_experts.core.errors import InputError
from scene_experts.data.fetch.catalog import COLLECTIONS, SCENES, Defaults, defaults_in, defaults_of, one, select
from scene_experts.data.images import check_policy
from support.messages import naming


def test_the_seventeen_scenes() -> None:
    by_set = {c.key: sorted(s.name for s in SCENES if s.collection == c) for c in COLLECTIONS}
    assert by_set == {
        "mipnerf360": ["bicycle", "bonsai", "counter", "garden", "kitchen", "room", "stump"],
        "tandt": ["train", "truck"],
        "db": ["drjohnson", "playroom"],
        "bungeenerf": ["amsterdam", "bilbao", "hollywood", "pompidou", "quebec", "rome"],
    }
    assert len({s.name for s in SCENES}) == len(SCENES) == 17
    assert files("scene_experts.evaluate").joinpath("paper.yaml").is_file()


def test_every_entry_can_be_used() -> None:
    for scene in SCENES:
        assert check_policy(scene.resolution) == scene.resolution and scene.split == "mod8"
        assert scene.inside and all(place.split("/")[-1] == scene.name for place in scene.inside)
    for archive in {c.archive for c in COLLECTIONS}:
        assert archive.urls and all(url.startswith("https://") for url in (*archive.urls, archive.page))
        assert archive.sha256 is None or (re.fullmatch("[0-9a-f]{64}", archive.sha256) and archive.bytes)
    outdoor = {s.name for s in SCENES if s.resolution == "inria:4"}
    assert outdoor == {"bicycle", "garden", "stump"}  # as the evaluation script of 3DGS reads them


def test_words_select_scenes() -> None:
    assert [s.name for s in select(["truck", "mipnerf360/bonsai", "tandt", "catalog:bonsai"])] == ["bonsai", "truck", "train"]
    assert len(select(["all"])) == 17 and select([]) == []
    assert one("Quebec").path == "bungeenerf/quebec"
    with pytest.raises(InputError, match=r"'tandt'.*truck, train"):
        one("tandt")


def test_a_scene_brings_its_units_and_numbers() -> None:
    brought = defaults_of("catalog:bonsai")
    assert brought.normalise == "none" and ("scene.voxel_size", 0.001) in brought.numbers
    for args in (["-s", "catalog:bonsai"], ["--data=catalog:mipnerf360/bonsai"], ["-s=catalog:bonsai"], ["catalog:bonsai", "--out", "a"]):
        assert defaults_in(args) == brought
    for args in ([], ["bonsai"], ["--out", "x/catalog:bonsai"]):
        assert defaults_in(args) == defaults_of(Path("bonsai")) == Defaults()


@pytest.mark.parametrize(("word", "hint"), [("bonzai", "'bonsai'"), ("mipnerf/garden", "'mipnerf360/garden'"), ("tant", "'tandt'")])
def test_unknown_words_suggest_the_nearest_names(word: str, hint: str) -> None:
    with pytest.raises(InputError, match=naming(word, hint)):
        select([word])
