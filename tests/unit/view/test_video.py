"""Frames on disk: exact pictures, and a video that can be read back."""

import json

import numpy as np
import pytest
from PIL import Image

from scene_experts.core.errors import InputError, RunError
from scene_experts.evaluate import pictures
from scene_experts.view import video
from support.messages import naming


def frames(count=6, size=(33, 47)):
    y, x = np.mgrid[: size[0], : size[1]]
    return [np.stack([x * 5, y * 7, np.full_like(x, 20 * i)], 2).astype(np.uint8) for i in range(count)]


def test_pictures_are_the_frames_and_those_of_a_longer_path_are_removed(tmp_path):
    assert video.write_pictures(tmp_path, frames(5)) == 5
    (tmp_path / "mine.png").write_bytes(b"kept")
    assert video.write_pictures(tmp_path, frames(3)) == 3
    assert sorted(p.name for p in tmp_path.iterdir()) == ["00000.png", "00001.png", "00002.png", "frames.json", "mine.png"]
    assert np.array_equal(pictures.read_picture(tmp_path / "00002.png"), frames(3)[2])
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="--out"):
        video.write_pictures(tmp_path / "file", frames(1))


def test_foreign_numbered_pictures_are_not_replaced(tmp_path):
    (tmp_path / "00007.png").write_bytes(b"a photograph")
    drawn = []
    with pytest.raises(InputError, match=naming("00007.png", "--out")):
        video.write_pictures(tmp_path, (drawn.append(f) or f for f in frames()))
    assert not drawn and [p.name for p in tmp_path.iterdir()] == ["00007.png"]
    (tmp_path / "00007.png").unlink()
    video.write_pictures(tmp_path, frames(2))
    (tmp_path / "00007.png").write_bytes(b"a photograph")
    with pytest.raises(InputError, match="--out"):
        video.write_pictures(tmp_path, frames())
    (tmp_path / "frames.json").write_text("{")
    with pytest.raises(InputError, match=naming("00000.png")):
        video.write_pictures(tmp_path, frames())


def test_floats_lie_beside_the_pictures_and_go_with_them(tmp_path):
    depth = lambda frame: np.full((4, 5), 2.5 + frame, np.float32)  # noqa: E731
    video.write_pictures(tmp_path, frames(3), depth)
    with Image.open(tmp_path / "00002.tiff") as found:
        assert found.mode == "F" and np.array_equal(np.array(found), depth(2))
    video.write_pictures(tmp_path, frames(2), depth)
    assert sorted(path.name for path in tmp_path.glob("*.tiff")) == ["00000.tiff", "00001.tiff"]
    video.write_pictures(tmp_path, frames(2), names=("a.jpg", "b.jpg"))
    assert json.loads((tmp_path / "frames.json").read_text()) == {"frames": 2, "floats": False, "photographs": ["a.jpg", "b.jpg"]}
    assert not list(tmp_path.glob("*.tiff"))
    (tmp_path / "00001.tiff").write_bytes(b"a scan")
    video.write_pictures(tmp_path, frames(1))
    assert (tmp_path / "00001.tiff").read_bytes() == b"a scan"
    with pytest.raises(InputError, match=naming("00001.tiff")):
        video.write_pictures(tmp_path, frames(1), depth)


def test_pictures_of_an_interrupted_path_are_replaced(tmp_path):
    def stopped():
        yield from frames(3)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        video.write_pictures(tmp_path, stopped())
    assert video.write_pictures(tmp_path, frames(2)) == 2
    assert sorted(p.name for p in tmp_path.iterdir()) == ["00000.png", "00001.png", "frames.json"]


def test_an_incomplete_video_is_an_error(tmp_path, monkeypatch):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    whole = ffmpeg.count_frames_and_secs
    monkeypatch.setattr(ffmpeg, "count_frames_and_secs", lambda path: (whole(path)[0] - 1, 1.0))
    with pytest.raises(RunError, match=naming(5, 6)):
        video.write_video(tmp_path / "v.mp4", frames(), 12.0)
    assert list(tmp_path.iterdir()) == []


def test_only_the_last_line_of_the_encoders_message_is_shown(tmp_path, monkeypatch):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")

    def fail(path):
        raise RuntimeError("FFMPEG call failed with 183:\nffmpeg version 9 built with gcc\nmoov atom not found\n")

    monkeypatch.setattr(ffmpeg, "count_frames_and_secs", fail)
    with pytest.raises(RunError, match=r"a\.mp4: moov atom not found; free some space") as error:
        video.write_video(tmp_path / "a.mp4", frames(), 12.0)
    assert "gcc" not in str(error.value)


def test_a_video_reads_back(tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    assert video.write_video(tmp_path / "v.mp4", frames(), 12.0) == 6
    reader = ffmpeg.read_frames(str(tmp_path / "v.mp4"))
    meta = next(reader)
    found = [np.frombuffer(f, np.uint8).reshape(34, 48, 3) for f in reader]
    assert meta["size"] == (48, 34) and meta["fps"] == 12.0 and len(found) == 6  # odd sizes grow by a pixel
    assert np.abs(found[0][:33, :47].astype(int) - frames()[0]).mean() < 12
    assert [p.name for p in tmp_path.iterdir()] == ["v.mp4"]


def test_without_an_encoder_the_error_says_what_to_install(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(InputError, match="video"):
        video.import_ffmpeg()


def test_which_names_are_videos(tmp_path):
    assert video.is_video(tmp_path / "a.MP4") and not video.is_video(tmp_path / "folder")
