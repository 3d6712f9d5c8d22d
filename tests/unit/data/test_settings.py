"""How a capture is read, as plain JSON."""

from pathlib import Path

from scene_experts.core.plain import to_json
from scene_experts.data.settings import Data


def test_chosen_views_are_a_setting():
    assert Data(Path("box"), views=Path("block0.json")).settings()["views"] == "block0.json"


def test_settings_are_everything_but_the_path():
    for data in (Data(Path("box")), Data(Path("box"), background=(0.0, 0.5, 1.0), max_views=3)):
        whole = to_json(data)
        whole.pop("path")
        assert whole.pop("views") is None  # newer than the first records, so only there if it is given
        assert data.settings() == whole and list(data.settings()) == list(whole)
