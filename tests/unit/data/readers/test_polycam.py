"""Raw data of Polycam, against the projection that its matrices stand for."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from scene_experts.core.errors import InputError
from scene_experts.data.readers.polycam import READER
from scene_experts.data.readers.reader import ReadOptions
from support.captures import load
from support.foreign_poses import make_polycam
from support.messages import naming


def test_a_point_ahead_of_the_phone_is_in_the_middle(tmp_path: Path) -> None:
    """The third column points backwards and the second up, as in ARKit; the fourth is the place of the phone."""
    make_polycam(tmp_path)
    image = READER.read(tmp_path, ReadOptions()).images[2]
    value = json.loads((tmp_path / "keyframes/corrected_cameras/view_002.json").read_text())
    T = np.array([[value[f"t_{r}{c}"] for c in range(4)] for r in range(3)])
    ahead, higher = T[:, 3] - 2 * T[:, 2], T[:, 3] - 2 * T[:, 2] + 0.1 * T[:, 1]
    lens = image.lens
    assert lens is not None and (lens.fx, lens.fy) == (value["fx"], value["fy"])

    def pixel(X: np.ndarray) -> tuple[float, float]:
        x, y, z = image.world_to_cam[:3, :3] @ X + image.world_to_cam[:3, 3]
        return lens.fx * x / z + lens.cx, lens.fy * y / z + lens.cy

    assert pixel(ahead) == pytest.approx((value["cx"], value["cy"]), abs=1e-9)
    assert pixel(higher) == pytest.approx((value["cx"], value["cy"] - 0.05 * value["fy"]), abs=1e-9)


def test_corrected_keyframes_come_first(tmp_path: Path) -> None:
    make_polycam(tmp_path / "a", kind="")
    raw = load(tmp_path / "a")
    assert any("phone" in w for w in raw.warnings)
    made = make_polycam(tmp_path / "b")
    for part in ("cameras", "images"):
        shutil.copytree(tmp_path / "a/keyframes" / part, tmp_path / "b/keyframes" / part)
    for path in (tmp_path / "b/keyframes/cameras").iterdir():
        path.write_text("{}")
    capture = load(tmp_path / "b")
    assert not any("phone" in w for w in capture.warnings) and len(capture.views) == len(made.images)
    assert len(load(tmp_path / "b/keyframes").views) == len(made.images)


def test_damaged_files(tmp_path: Path) -> None:
    make_polycam(tmp_path)
    path = tmp_path / "keyframes/corrected_cameras/view_001.json"
    whole = json.loads(path.read_text())
    for change, fact in (({"t_11": None}, "t_00"), ({"t_11": 5.0}, "rotation"), ({"fx": 0}, "focal"), ({"width": 48.5}, "48.5")):
        path.write_text(json.dumps({**whole, **change}))
        with pytest.raises(InputError, match=naming("view_001", fact)):
            load(tmp_path)
    with pytest.raises(InputError, match="--images"):
        load(tmp_path, images="keyframes/corrected_images")
