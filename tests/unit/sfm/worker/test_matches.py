"""Pairs of photographs, without pycolmap."""

import json
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from scene_experts.sfm.worker import matches


def test_photographs_that_fit_too_few_others_are_weak():
    names = list("abcdefgh")
    whole = [[one, other] for one in "abcde" for other in "abcde" if one < other]
    apart = [[one, other] for one in "fgh" for other in "fgh" if one < other]
    assert matches.find_weak(names, [*whole, *apart]) == set("fgh")
    assert matches.find_weak(names, [*whole, *([n, m] for n in "fgh" for m in "abcd")]) == set()
    assert matches.find_weak(names, [*whole, *([n, m] for n in "fgh" for m in "abc")]) == set("fgh")
    assert matches.find_weak(["a", "b"], []) == {"a", "b"}


def test_spare_pairs_are_matched_for_weak_photographs_alone(monkeypatch, capsys):
    matched = []

    class Database:
        @staticmethod
        @contextmanager
        def open(path):
            yield Database

        @staticmethod
        def read_all_images():
            return [SimpleNamespace(image_id=i, name=name) for i, name in enumerate("abcdef")]

        @staticmethod
        def read_two_view_geometry_num_inliers():
            pairs = [(i, j) for i in range(5) for j in range(i + 1, 5)]
            return [*pairs, (0, 5)], [30] * len(pairs) + [0]

    colmap = SimpleNamespace(Database=Database, pair_id_to_image_pair=lambda pair: pair)
    monkeypatch.setattr(matches, "match_pairs", lambda colmap, ask, pairs: matched.append(pairs))
    ask = {"database": "", "pairs": [["a", "b"]], "spare": [["a", "c"], ["b", "f"], ["e", "f"]]}
    matches.match_all(colmap, ask)
    assert matched == [[["a", "b"]], [["b", "f"], ["e", "f"]]]
    assert json.loads(capsys.readouterr().out) == {"step": "weak", "photographs": 1, "pairs": 2}
    matched.clear()
    matches.match_all(None, {**ask, "spare": []})
    assert matched == [[["a", "b"]]]


def test_learned_matches_are_added_to_those_that_colmap_verified(tmp_path, monkeypatch):
    """Photographs 1 and 2 have matches of both kinds, 2 and 3 learned ones alone, given in the other order."""
    written = {}

    class Database:
        @staticmethod
        @contextmanager
        def open(path):
            written["path"] = path
            yield Database

        read_all_images = staticmethod(lambda: [SimpleNamespace(image_id=i, name=f"{i}.jpg") for i in (1, 2, 3)])
        read_keypoints = staticmethod(lambda i: np.full((i % 3, {1: 4, 2: 6, 3: 0}[i]), 9, np.float32))  # the third has none
        read_two_view_geometries = staticmethod(lambda: ([(1, 2)], [SimpleNamespace(inlier_matches=np.array([[0, 1]], np.uint32))]))
        write_keypoints = staticmethod(lambda i, rows: written.update({i: rows}))
        write_matches = staticmethod(lambda i, j, rows: written.update({(i, j): rows.tolist()}))
        clear_matches = clear_two_view_geometries = clear_keypoints = staticmethod(lambda: None)

    def verify(path, pairs, options):
        written["pairs"], written["seed"] = Path(pairs).read_text().splitlines(), options.ransac.random_seed

    colmap = SimpleNamespace(
        Database=Database,
        pair_id_to_image_pair=lambda key: key,
        verify_matches=verify,
        TwoViewGeometryOptions=lambda: SimpleNamespace(ransac=SimpleNamespace(random_seed=-1)),
    )
    (tmp_path / "db").write_bytes(b"database")
    places = {f"k{i}": np.array([[5.0 + i, 6.0], [7.0, 8.0]], np.float32) for i in range(3)}
    more = {"pairs": np.array([[0, 1], [2, 1]]), "m0": np.array([[1, 0]], np.uint32), "m1": np.array([[0, 1]], np.uint32)}
    np.savez(tmp_path / "all.npz", **places, **more)
    ask = {"database": str(tmp_path / "db"), "learned": str(tmp_path / "all.npz"), "names": ["1.jpg", "2.jpg", "3.jpg"], "seed": 4}
    matches.add_learned(colmap, ask)
    assert written["path"] == ask["database"] == str(tmp_path / "db.learned") and (tmp_path / "db").read_bytes() == b"database"
    assert written[1].tolist() == [[9, 9, 9, 9], [5, 6, 1, 0], [7, 8, 1, 0]]
    assert written[2][2:].tolist() == [[6, 6, 1, 0, 0, 1], [7, 8, 1, 0, 0, 1]]  # behind the two of COLMAP
    assert written[1, 2] == [[0, 1], [1 + 1, 2 + 0]] and written[2, 3] == [[2 + 1, 0]] and len(written[3]) == 2
    assert written["pairs"] == ["1.jpg 2.jpg", "2.jpg 3.jpg"] and written["seed"] == 4
