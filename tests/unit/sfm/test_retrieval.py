"""Photographs that show the same things are found by their features."""

import sqlite3

import numpy as np
import pytest

from scene_experts.sfm import retrieval
from scene_experts.sfm.retrieval import aggregate, describe_photos, rank_alike, read_largest


def write_database(path, photographs, columns=6):
    """COLMAP's tables with photographs {name: (sizes [n], descriptors [n, 128])}."""
    with sqlite3.connect(path) as there:
        there.execute("CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT)")
        for table in ("keypoints", "descriptors"):
            there.execute(f"CREATE TABLE {table} (image_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB)")
        for i, (name, (sizes, found)) in enumerate(photographs.items(), 7):
            there.execute("INSERT INTO images VALUES (?, ?)", (i, name))
            keypoints = np.zeros((len(sizes), columns), np.float32)
            keypoints[:, 2] = sizes
            for table, rows in (("keypoints", keypoints), ("descriptors", found.astype(np.uint8))):
                there.execute(f"INSERT INTO {table} VALUES (?, ?, ?, ?)", (i, *rows.shape, rows.tobytes()))
    return path


def make_places(places=4, photographs=3, features=120, seed=0):
    """Photographs of several places: those of one place share most of their features, in another order and with noise."""
    rng = np.random.default_rng(seed)
    found = {}
    for place in range(places):
        own = rng.integers(0, 120, (features, 128))
        for k in range(photographs):
            seen = own[rng.permutation(features)[: features * 3 // 4]] + rng.integers(-8, 9, (features * 3 // 4, 128))
            found[f"{k}-{place}.jpg"] = (rng.uniform(1, 9, len(seen)), seen.clip(0, 255))
    return found


@pytest.mark.parametrize("columns", [4, 6])
def test_photographs_of_one_place_are_most_alike(tmp_path, columns):
    photographs = make_places()
    names = sorted(photographs)
    vectors = describe_photos(write_database(tmp_path / "colmap.db", photographs, columns), names)
    assert np.allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-5)
    for i, row in enumerate(rank_alike(vectors, 2)):
        assert {names[j][2:] for j in row} == {names[i][2:]} and i not in row
    again = describe_photos(tmp_path / "colmap.db", names)
    assert np.array_equal(vectors, again)


def test_photographs_without_features_are_like_none(tmp_path):
    photographs = {**make_places(2, 2), "black.jpg": (np.zeros(0), np.zeros((0, 128)))}
    vectors = describe_photos(write_database(tmp_path / "colmap.db", photographs), [*sorted(photographs), "unread.jpg"])
    assert not vectors[4].any() and not vectors[5].any() and rank_alike(vectors, 1)[0] == 2
    nothing = describe_photos(write_database(tmp_path / "empty.db", {}), ["a.jpg", "b.jpg"])
    assert rank_alike(nothing, 5).tolist() == [[1], [0]]


def test_the_largest_features_are_used(tmp_path, monkeypatch):
    monkeypatch.setattr(retrieval, "LARGEST", 2)
    found = np.eye(128)[:5] * 200
    database = write_database(tmp_path / "colmap.db", {"a.jpg": (np.array([1.0, 9.0, 2.0, 8.0, 3.0]), found)})
    (rows,) = read_largest(database, ["a.jpg"])
    assert rows.argmax(1).tolist() == [1, 3] and np.allclose(np.linalg.norm(rows, axis=1), 1)


def test_a_vector_is_the_sums_of_the_differences_from_the_centres():
    rng = np.random.default_rng(1)
    centres, found = rng.normal(size=(3, 4)).astype(np.float32), rng.normal(size=(40, 4)).astype(np.float32)
    sums = np.zeros((3, 4))
    for row in found:
        c = int(np.argmin([np.sum((row - centre) ** 2) for centre in centres]))
        sums[c] += row - centres[c]
    sums /= np.linalg.norm(sums, axis=1, keepdims=True)
    assert np.allclose(aggregate(found, centres), (sums / np.linalg.norm(sums)).ravel(), atol=1e-5)


def test_ranks_are_found_block_by_block(monkeypatch):
    vectors = np.random.default_rng(2).normal(size=(9, 5)).astype(np.float32)
    whole = rank_alike(vectors, 4)
    monkeypatch.setattr(retrieval, "BLOCK", 2)
    assert np.array_equal(rank_alike(vectors, 4), whole)
    likeness = vectors @ vectors.T
    np.fill_diagonal(likeness, -np.inf)
    assert np.array_equal(whole, np.argsort(-likeness, axis=1)[:, :4])
