"""EXR pictures: channels, the curve of sRGB, and files that are refused."""

import contextlib
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.core.reading import exr
from scene_experts.core.reading.pictures import opening_picture

OpenEXR = pytest.importorskip("OpenEXR")
CURVE = {0.0: 0, 0.0031308: 10, 0.01: 25, 0.18: 118, 0.5: 188, 1.0: 255, 40.0: 255, -3.0: 0, float("nan"): 0, float("inf"): 255}
"""Bytes of sRGB for linear values: 255 times the curve of IEC 61966-2-1, by hand."""


def write(path: Path, **channels: np.ndarray) -> Path:
    OpenEXR.File({}, channels).write(str(path))
    return path


def read(path: Path) -> Image.Image:
    with opening_picture(path) as image:
        image.load()
        return image.copy()


def test_the_curve() -> None:
    assert exr.encode(np.array(list(CURVE), np.float32)).tolist() == list(CURVE.values())


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_grey_colour_and_alpha(tmp_path: Path, dtype: type) -> None:
    value = np.full((6, 8), 0.18, dtype)
    assert read(write(tmp_path / "a.exr", Y=value)).mode == "L"
    picture = read(write(tmp_path / "b.exr", R=value, G=value * 0, B=value + 2, A=value))
    assert picture.mode == "RGBA" and picture.size == (8, 6) and picture.getpixel((3, 3)) == (118, 0, 255, 46)  # alpha is not light
    assert read(write(tmp_path / "c.exr", R=value, G=value, B=value, depth=value)).mode == "RGB"


def test_other_channels_and_damaged_files_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "a.exr", Z=np.ones((6, 8), np.float32))
    with pytest.raises(InputError, match="the channels Z"):
        read(path)
    data = write(path, Y=np.ones((6, 8), np.float32)).read_bytes()
    for bad in (data[:40], data[: len(data) - 8], b"v/1\x01"):
        path.write_bytes(bad)
        with pytest.raises(InputError, match=r"a\.exr"):
            read(path)
    at = data.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    path.write_bytes(data[: at + 8] + (2**20).to_bytes(4, "little") * 2 + data[at + 16 :])  # a bomb
    with pytest.raises(InputError, match=r"a\.exr"):
        read(path)


def test_what_other_threads_print_is_no_failure_of_the_file(capsys: pytest.CaptureFixture[str]) -> None:
    with contextlib.redirect_stdout(exr._Ear()) as ear:
        print("of the library")
        other = threading.Thread(target=print, args=("progress",))
        other.start()
        other.join()
        assert not sys.stdout.isatty()
    assert ear.said == "of the library\n" and capsys.readouterr().out == "progress\n"


def test_a_damaged_first_part_is_told_and_no_other_part_is_read_for_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ramp = np.arange(64 * 64, dtype=np.float32).reshape(64, 64)  # is compressed, so that damage shows
    parts = [OpenEXR.Part({}, {"Y": ramp}, "left"), OpenEXR.Part({}, {"Y": ramp * 0}, "right")]
    OpenEXR.File(parts).write(str(tmp_path / "a.exr"))
    data = (tmp_path / "a.exr").read_bytes()
    damaged = data[: len(data) // 3] + bytes(100) + data[len(data) // 3 + 100 :]
    (tmp_path / "a.exr").write_bytes(damaged)
    with pytest.raises(InputError, match=r"a\.exr"):
        read(tmp_path / "a.exr")
    assert not capsys.readouterr().out
