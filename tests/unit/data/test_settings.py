"""How a capture is read, as plain JSON."""

from pathlib import Path

from scene_experts.data.settings import Data


def test_chosen_views_are_a_setting():
    assert Data(Path("box"), views=Path("block0.json")).settings()["views"] == "block0.json"


def test_settings_are_what_differs_from_the_defaults_but_the_path():
    assert Data(Path("box")).settings() == {"type": "Data"}
    assert Data(Path("box"), background=(0.0, 0.5, 1.0), max_views=3).settings() == {
        "type": "Data",
        "max_views": 3,
        "background": [0.0, 0.5, 1.0],
    }
