"""Where photographs were taken, and which were taken near each other."""

import sqlite3

import numpy as np
import pytest
from PIL import Image

from scene_experts.sfm.positions import EARTH, find_near, read_positions


def write_database(path, places, system=0):
    """COLMAP's tables with photographs {name: (latitude, longitude, altitude) or None}."""
    with sqlite3.connect(path) as there:
        there.execute("CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT)")
        there.execute("CREATE TABLE pose_priors (corr_data_id INTEGER, position BLOB, coordinate_system INTEGER)")
        for i, (name, place) in enumerate(places.items(), 3):
            there.execute("INSERT INTO images VALUES (?, ?)", (i, name))
            if place is not None:
                there.execute("INSERT INTO pose_priors VALUES (?, ?, ?)", (i, np.array(place).tobytes(), system))
    return path


@pytest.mark.parametrize("east", [8.5, 179.9999, -179.9999])
def test_degrees_become_metres(tmp_path, east):
    step = np.degrees(100 / EARTH)
    across = step / np.cos(np.radians(60.0))
    turned = (east + across + 180) % 360 - 180
    names = {
        "a": (60.0, east, 5.0),
        "b": (60.0 + step, east, 7.0),
        "c": (60.0, turned, 0.0),
        "d": None,
        "e": (np.nan, 1.0, 0.0),
        "f": (95.0, 1.0, 0.0),
    }
    found = read_positions(write_database(tmp_path / "db", names), list(names))
    assert np.isnan(found[3:]).all()
    np.testing.assert_allclose(found[1] - found[0], (0, 100), atol=1e-3)
    np.testing.assert_allclose(found[2] - found[0], (100, 0), atol=1e-3)
    np.testing.assert_allclose(found[:3].mean(0), 0, atol=1e-9)


def test_places_in_another_system_and_other_tables_are_none(tmp_path):
    names = {"a": (1.0, 2.0, 3.0)}
    assert np.isnan(read_positions(write_database(tmp_path / "one", names, system=1), ["a"])).all()
    with sqlite3.connect(tmp_path / "two") as there:
        there.execute("CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT)")
    assert np.isnan(read_positions(tmp_path / "two", ["a"])).all()


def test_the_nearest_are_paired_where_the_places_are_large():
    places = np.array([[x, y] for y in range(5) for x in range(5)], float)
    places[7] = np.nan
    near = find_near(100 * places, 4)
    assert near == sorted(set(near)) and all(i < j for i, j in near)
    assert {(0, 1), (0, 5), (11, 12), (12, 13), (12, 17)} <= set(near) and not any(7 in pair for pair in near) and (0, 24) not in near
    assert find_near(places, 4) == [], "within the noise of GPS"
    assert find_near(1000 * places[:4], 4) == [], "too few"


def test_colmap_notes_them_as_they_are_read(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    (tmp_path / "images").mkdir()
    rng = np.random.default_rng(0)
    for i in range(2):
        exif = Image.Exif()
        exif.get_ifd(0x8825).update({1: "N", 2: (47.0, 22.0, 30.0 + i), 3: "W", 4: (8.0, 32.0, 10.0), 5: 0, 6: 400.0})
        Image.fromarray(rng.integers(0, 255, (60, 80, 3), dtype=np.uint8)).save(tmp_path / "images" / f"{i}.jpg", exif=exif)
    pycolmap.extract_features(str(tmp_path / "db"), str(tmp_path / "images"))
    found = read_positions(tmp_path / "db", ["0.jpg", "1.jpg"])
    np.testing.assert_allclose(found[1] - found[0], (0, np.radians(1 / 3600) * EARTH), atol=1e-3)
