"""Colours of points as bytes or fractions of 1."""

from pathlib import Path

import numpy as np
import pytest

from scene_experts.core.reading.budget import Damaged
from scene_experts.data.readers.colours import to_bytes

FILE = Path("points3D.txt")


@pytest.mark.parametrize(
    ("given", "right", "word"),
    [
        ([[0, 128, 255], [1, 0, 0]], [[0, 128, 255], [1, 0, 0]], ""),
        ([[0, 0, 0], [0, 0, 0]], [[0, 0, 0], [0, 0, 0]], ""),
        ([[0.2, 0.4, 1.0], [0, 1, 0]], [[51, 102, 255], [0, 255, 0]], "fractions"),
        ([[1, 0, 0], [0, 1, 1]], [[255, 0, 0], [0, 255, 255]], "fractions"),
        ([[0.2, 0.4, 1.2]], [[51, 102, 255]], "fractions"),  # a little too bright
        ([[127.5, 12.25, 0.4], [0.5, 0.25, 0.75]], [[128, 12, 0], [0, 0, 1]], ""),  # means of bytes
        ([[0.2, 0.4, 0.6], [200, 10, 0], [1, 0, 0]], [[51, 102, 153], [200, 10, 0], [1, 0, 0]], "1 of 3 points"),  # two files joined
    ],
)
def test_the_values_tell_the_unit(given: list, right: list, word: str) -> None:
    rgb, notes = to_bytes(np.array(given, dtype=np.float64), FILE)
    assert rgb.dtype == np.uint8 and rgb.tolist() == right
    assert (word in notes[0] and FILE.name in notes[0]) if word else not notes


def test_no_points_and_bad_values() -> None:
    assert to_bytes(np.empty((0, 3)), FILE)[0].shape == (0, 3)
    for bad in (-1.0, 256.0, float("nan")):
        with pytest.raises(Damaged):
            to_bytes(np.full((1, 3), bad), FILE)
