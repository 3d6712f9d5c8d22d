"""Frames of a video: the sharpest of each segment."""

import numpy as np
import pytest
from PIL import Image, ImageFilter

from scene_experts.core.errors import InputError
from scene_experts.sfm import frames


def test_one_frame_of_each_segment_is_chosen():
    assert frames.choose_sharpest([1, 3, 2, 9, 8, 7, 0, 0, 5], [1.0] * 9, 3) == [1, 3, 8]
    assert frames.choose_sharpest([1.0, 2.0], [1.0, 1.0], 5) == [0, 1] and frames.choose_sharpest([], [], 5) == []


def test_copies_are_left_out_and_slow_parts_get_fewer_frames():
    changes = [0.0, 4.0, 0.1, 4.4, 4.0, 0.0, 0.2, 4.0, 9.0, 4.0, 4.0]
    motion = frames.measure_motion(changes)
    assert [i for i, share in enumerate(motion) if not share] == [2, 5, 6] and max(motion) == 1.0 == motion[0]
    assert frames.choose_sharpest([9.0] * 11, motion, 20) == [0, 1, 3, 4, 7, 8, 9, 10]
    repeated = [0.0, *[8.0, 0.1, 0.0, 0.1, 0.05] * 20]  # 12 pictures a second, stored at 60
    assert [i for i, share in enumerate(frames.measure_motion(repeated)) if share] == [0, *range(1, 101, 5)]
    slow = [1.0] * 20 + [0.25] * 40  # as much motion in the first 20 frames as in twice the other 40
    chosen = frames.choose_sharpest([1.0] * 60, slow, 9)
    assert len(chosen) == 9 and sum(i < 20 for i in chosen) == 6
    assert frames.measure_motion([0.0]) == [1.0] and frames.measure_motion([]) == [] and frames.measure_motion([0.0, 0.0]) == [1.0, 1.0]


def test_blur_lowers_the_sharpness():
    picture = Image.fromarray(np.random.default_rng(0).integers(0, 255, (48, 64), np.uint8))
    grades = [frames.sharpness(np.asarray(picture.filter(ImageFilter.GaussianBlur(r)))) for r in (0, 1, 2)]
    assert grades[0] > grades[1] > grades[2]


def test_the_sharp_frames_of_a_video_are_extracted_in_order(tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    generator = np.random.default_rng(0)
    stream = ffmpeg.write_frames(str(tmp_path / "walk.mp4"), (96, 64), fps=10, macro_block_size=2, quality=9)
    stream.send(None)
    for shade in (40, 120, 200):  # the middle one of every three frames is sharp
        noise = Image.fromarray((shade + generator.integers(-30, 30, (64, 96, 3))).astype(np.uint8))
        for blur in (4, 0, 4):
            stream.send(np.ascontiguousarray(noise.filter(ImageFilter.GaussianBlur(blur))))
    stream.close()
    said = []
    names, still = frames.extract_frames(tmp_path / "walk.mp4", tmp_path / "out", 3, lambda *a: said.append(a))
    assert still == 0 and names == ["frame_00001.jpg", "frame_00002.jpg", "frame_00003.jpg"] and said[-1] == ("frames", 3, 3)
    pictures = [np.asarray(Image.open(tmp_path / "out" / name)).astype(float) for name in names]
    assert [p.shape for p in pictures] == [(64, 96, 3)] * 3
    assert np.allclose([p.mean() for p in pictures], [40, 120, 200], atol=6) and min(p.std() for p in pictures) > 8
    assert (9, 9) in [step[1:] for step in said]


def test_more_frames_than_an_expression_of_ffmpeg_may_be_deep(tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    stream = ffmpeg.write_frames(str(tmp_path / "long.mp4"), (16, 16), fps=10, macro_block_size=2)
    stream.send(None)
    for shade in range(130):
        stream.send(np.full((16, 16, 3), 20 + 90 * (shade % 2) + shade, np.uint8))
    stream.close()
    names, _ = frames.extract_frames(tmp_path / "long.mp4", tmp_path / "out", 120, lambda *_: None)
    assert len(names) == len(list((tmp_path / "out").glob("*.jpg"))) == 120


def test_a_file_that_is_not_a_video_is_reported(tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    (tmp_path / "broken.mp4").write_bytes(b"nothing of the kind")
    with pytest.raises(InputError, match=r"broken\.mp4 as a video: .*; give a video or a folder of photographs"):
        frames.extract_frames(tmp_path / "broken.mp4", tmp_path / "out", 3, lambda *_: None)
