"""The CSV files of RealityCapture and RealityScan, against published values and the program's own formulas."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.data.readers.reader import PosedImage, ReadOptions
from scene_experts.data.readers.realitycapture import READER
from support.captures import load
from support.foreign_poses import make_realitycapture
from support.messages import naming

HEADER = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"
# One camera that a user exported twice: as this CSV file, and as XMP, whose xcr:Rotation is [R] of x = [R | t] X, row by row
# (forums.unrealengine.com, "Different rotation of cameras in XMP and CSV"; the last number is printed with three digits there).
ANGLES = "163.736597399311,83.4154313461628,174.386496244756"
ROTATION = (
    (0.982594073038806, 0.185426733553445, -0.0112166890261935),
    (-0.032113633044729, 0.11008102707942, -0.993403685341366),
    (-0.18296885582437, 0.976472781986697, 0.114),
)


def read(folder: Path, row: str, header: str = HEADER, size: tuple[int, int] = (60, 40)) -> tuple[PosedImage, list[str]]:
    Image.new("RGB", size).save(folder / "a.png")
    (folder / "export.csv").write_text(f"{header}\n{row}\n")
    raw = READER.read(folder, ReadOptions())
    return raw.images[0], raw.warnings


def test_the_rotation_is_that_of_the_same_camera_s_xmp_file(tmp_path: Path) -> None:
    image, _ = read(tmp_path, f"a.png,10,20,30,{ANGLES},24,0,0,0,0,0,0,0,0")
    error = np.abs(image.world_to_cam[:3, :3] - ROTATION)
    error[2, 2] -= 1.2e-4  # printed as 0.114
    assert error.max() < 1e-6
    np.testing.assert_allclose(image.world_to_cam @ (10, 20, 30, 1), (0, 0, 0, 1), atol=1e-9)  # the centre


@pytest.mark.parametrize(
    ("angles", "forward", "down"),
    [
        ("0,0,0", (0, 0, -1), (0, -1, 0)),  # looks down, the picture's top to the north
        ("90,0,0", (0, 0, -1), (-1, 0, 0)),  # the top to the east: headings turn clockwise
        ("0,90,0", (0, 1, 0), (0, 0, -1)),  # looks north, upright
        ("90,90,0", (1, 0, 0), (0, 0, -1)),  # looks east
    ],
)
def test_headings_and_pitches(tmp_path: Path, angles: str, forward: tuple, down: tuple) -> None:
    image, _ = read(tmp_path, f"a.png,0,0,0,{angles},24,0,0,0,0,0,0,0,0")
    np.testing.assert_allclose(image.world_to_cam[2, :3], forward, atol=1e-12)
    np.testing.assert_allclose(image.world_to_cam[1, :3], down, atol=1e-12)


@pytest.mark.parametrize("size", [(60, 40), (40, 60)])
def test_the_lens_is_that_of_the_program_s_own_conversion_to_opencv(tmp_path: Path, size: tuple[int, int]) -> None:
    """Its OpenCV export writes f * scale, px * scale + 0.5 * width, and the coefficients as k1, k2, t2, t1, k3."""
    k1, k2, k3, k4, t1, t2 = -0.1, 0.02, -0.003, 0.004, 0.001, -0.002
    image, _ = read(tmp_path, f"a.png,0,0,0,0,0,0,24,0.01,-0.02,{k1},{k2},{k3},{k4},{t1},{t2}", size=size)
    lens, x, y = image.lens, 0.3, -0.2
    assert lens is not None and (lens.width, lens.height) == size
    assert lens.fx == lens.fy == pytest.approx(24 / 36 * 60, abs=1e-12)
    assert (lens.cx, lens.cy) == pytest.approx((size[0] / 2 + 0.6, size[1] / 2 - 1.2), abs=1e-12)
    p1, p2, r2 = t2, t1, x * x + y * y
    bend = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
    expected = x * bend + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * bend + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    u, v = lens.distort(np.array([x]), np.array([y]))
    assert (u[0], v[0]) == pytest.approx(expected, abs=1e-12)


def test_columns_of_realityscan_2_and_other_delimiters(tmp_path: Path) -> None:
    header = "\ufeff#cameras 1\r\n#name,x,y,alt,yaw,pitch,roll,f_35mm,px_norm,py_norm"
    image, _ = read(tmp_path, "a.png,1,2,3,90,90,0,24,0,0", header)
    assert image.lens is not None and image.lens.model == "PINHOLE" and image.lens.fx == 40
    again, _ = read(tmp_path, "a.png;1;2;3;90;90;0;24;0;0", header.replace(",", ";"))
    np.testing.assert_array_equal(again.world_to_cam, image.world_to_cam)


def test_principal_points_in_mm_are_told(tmp_path: Path) -> None:
    image, warnings = read(tmp_path, "a.png,0,0,0,0,0,0,24,0.72,-0.36,0,0,0,0,0,0")
    assert image.lens is not None and (image.lens.cx, image.lens.cy) == pytest.approx((31.2, 19.4))
    assert any("mm" in w for w in warnings)


@pytest.mark.parametrize(("more", "told"), [("-0.1,0,0,0,0,0", True), ("-0.1,0.02,0,0,0,0", False), ("0,0,0,0,0,0", False)])
def test_a_lens_that_may_be_a_division_model_is_told(tmp_path: Path, more: str, told: bool) -> None:
    _, warnings = read(tmp_path, f"a.png,0,0,0,0,0,0,24,0,0,{more}")
    assert any("Division" in w for w in warnings) == told


def test_positions_in_degrees_are_told(tmp_path: Path) -> None:
    make_realitycapture(tmp_path)
    lines = (tmp_path / "cameras.csv").read_text().splitlines()
    for i, line in enumerate(lines[2:]):
        name, _, _, _, *rest = line.split(",")
        lines[2 + i] = ",".join([name, f"8.5{i}", f"47.3{i}", f"{400 + 10 * i}", *rest])
    (tmp_path / "cameras.csv").write_text("\n".join(lines))
    assert any("degrees" in w for w in load(tmp_path).warnings)


@pytest.mark.parametrize(
    ("row", "facts"),
    [
        ("a.png,0,0,0,0,0,0", ["16 values", "7"]),
        ("a.png,0,0,0,0,east,0,24,0,0,0,0,0,0,0,0", ["a.png", "east"]),
        ("a.png,0,0,inf,0,0,0,24,0,0,0,0,0,0,0,0", ["a.png"]),
        ("a.png,0,0,0,0,0,0,0,0,0,0,0,0,0,0,0", ["focal"]),
        ("", ["export.csv"]),
    ],
)
def test_damaged_rows(tmp_path: Path, row: str, facts: list[str]) -> None:
    with pytest.raises(InputError, match=naming(*facts)):
        read(tmp_path, row)


def test_other_csv_files_are_not_taken_for_poses(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("name,x,y,alt\n")
    assert not READER.recognise(tmp_path)
    with pytest.raises(InputError, match="heading"):
        READER.read(tmp_path, ReadOptions(model=tmp_path / "a.csv"))
