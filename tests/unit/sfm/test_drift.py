"""How much the exposures of photographs differ, by the points that they share."""

import numpy as np
import pytest
from PIL import Image

from scene_experts.core.io import write_json
from scene_experts.data.lens import Lens
from scene_experts.data.readers.colmap_model import ColmapImage, Model
from scene_experts.sfm.drift import DRIFT, GAMMA, KEY, NOTE, drifts, find_stops, warn_of_steady

WIDTH, HEIGHT = 64, 48


@pytest.fixture
def model(tmp_path):
    """Photographs of 200 points, with 0, 0.5 and -1 stops, and a fourth that shows too few."""
    random = np.random.default_rng(0)
    colors, images, observations = random.uniform(0.25, 0.55, (200, 3)), [], {}
    for id, (stops, count) in enumerate(((0, 200), (0.5, 150), (-1, 120), (0.3, 10)), 1):
        places = random.permutation(WIDTH * HEIGHT)[:count]
        pixels = np.zeros((HEIGHT * WIDTH, 3))
        pixels[places] = colors[:count] * 2 ** (stops / GAMMA)
        pixels[places[:20]] = random.uniform(0.2, 0.9, (len(places[:20]), 3))  # something else is before them
        Image.fromarray((pixels.reshape(HEIGHT, WIDTH, 3) * 255).round().astype(np.uint8)).save(tmp_path / f"{id}.png")
        xy = np.stack([places % WIDTH, places // WIDTH], 1) + 0.5
        observations[id] = (np.concatenate([xy, [[3.0, 3.0]]]), np.concatenate([np.arange(count) + 7, [-1]]))
        images.append(ColmapImage(id, f"{id}.png", (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1))
    lens = Lens("PINHOLE", WIDTH, HEIGHT, (50.0, 50.0, 32.0, 24.0))
    rgb = (colors * 255).round().astype(np.uint8)
    return Model({1: lens}, tuple(images), np.arange(200) + 7, np.zeros((200, 3)), rgb, np.ones(200), observations)


def test_stops_are_those_that_were_made_where_enough_points_tell_them(model, tmp_path):
    found = find_stops(model, tmp_path)
    assert found == {"1.png": pytest.approx(0, abs=0.03), "2.png": pytest.approx(0.5, abs=0.03), "3.png": pytest.approx(-1, abs=0.05)}


def test_a_model_without_observations_tells_nothing(model, tmp_path):
    model.observations.clear()
    assert find_stops(model, tmp_path) == {}


def test_what_capture_measured_decides(tmp_path):
    assert not drifts(tmp_path)
    for value, told in ((DRIFT, True), (DRIFT / 2, False), (None, False), ("much", False)):
        write_json(tmp_path / NOTE, {KEY: value})
        assert drifts(tmp_path) is told
    (tmp_path / NOTE).write_text("[]")
    assert not drifts(tmp_path)


def test_a_training_on_steady_exposures_is_warned(tmp_path):
    assert warn_of_steady(tmp_path) is None  # nothing was measured
    for value, told in ((0.05, True), (0.29, True), (DRIFT, False), (None, False)):
        write_json(tmp_path / NOTE, {KEY: value})
        assert ("--exposure" in (warn_of_steady(tmp_path) or "")) is told
