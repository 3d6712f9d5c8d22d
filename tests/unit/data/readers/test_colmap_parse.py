"""The lines and records of COLMAP's files. Whole models are in test_colmap_model.py."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from scene_experts.core.errors import InputError
from scene_experts.core.reading.budget import COLMAP
from scene_experts.core.reading.source import opening
from scene_experts.data.lens import MODELS
from scene_experts.data.readers.colmap_parse import read_cameras_bin, read_cameras_txt

COLMAP_4 = (  # number, name and number of parameters, as pycolmap 4.2.1 states them
    (0, "SIMPLE_PINHOLE", 3), (1, "PINHOLE", 4), (2, "SIMPLE_RADIAL", 4), (3, "RADIAL", 5), (4, "OPENCV", 8), (5, "OPENCV_FISHEYE", 8),
    (6, "FULL_OPENCV", 12), (7, "FOV", 5), (8, "SIMPLE_RADIAL_FISHEYE", 4), (9, "RADIAL_FISHEYE", 5), (10, "THIN_PRISM_FISHEYE", 12),
    (11, "RAD_TAN_THIN_PRISM_FISHEYE", 16), (12, "SIMPLE_DIVISION", 4), (13, "DIVISION", 5), (14, "SIMPLE_FISHEYE", 3), (15, "FISHEYE", 4),
    (16, "EUCM", 6),
)  # fmt: skip


@pytest.mark.parametrize(("number", "name", "count"), COLMAP_4)
def test_every_camera_model_of_colmap_4_has_its_number(tmp_path: Path, number: int, name: str, count: int) -> None:
    params = [float(i + 1) for i in range(count)]
    (tmp_path / "cameras.bin").write_bytes(struct.pack(f"<QiiQQ{count}d", 1, 7, number, 64, 48, *params))
    (tmp_path / "cameras.txt").write_text(f"7 {name} 64 48 " + " ".join(map(str, params)))
    with opening(tmp_path / "cameras.bin", COLMAP) as binary, opening(tmp_path / "cameras.txt", COLMAP) as text:
        (found,), (same,) = read_cameras_bin(binary), read_cameras_txt(text)
    assert found == same and found[0] == 7
    assert (found[1].model, found[1].params, len(MODELS[name])) == (name, tuple(params), count)


def test_models_of_other_programs_are_no_models_of_colmap(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("7 BROWN 64 48 " + "1 " * 11)
    with opening(tmp_path / "cameras.txt", COLMAP) as text, pytest.raises(InputError, match="BROWN"):
        list(read_cameras_txt(text))
