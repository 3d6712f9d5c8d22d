"""Photographs that are there twice."""

from shutil import copyfile

import pytest

from scene_experts.core.errors import InputError
from scene_experts.sfm.copies import find_copies, leave_copies_out
from scene_experts.sfm.photos import find_photos
from support.messages import naming
from support.photos import write_black


def test_copies_are_left_out_and_told(tmp_path):
    folder = write_black(tmp_path, 3)
    assert leave_copies_out(folder, find_photos(folder)) == (find_photos(folder), "")
    copyfile(folder / "1.jpg", folder / "1 (copy).jpg")  # sorted before 1.jpg
    copyfile(folder / "1.jpg", folder / "z.jpg")
    found = find_photos(folder)
    kept, told = leave_copies_out(folder, found)
    assert [photo.name for photo in kept] == ["0.jpg", "1.jpg", "2.jpg"]
    assert told == "2 photographs are copies of others and left out: z.jpg (of 1.jpg), 1 (copy).jpg (of 1.jpg)"


def test_three_times_the_same_photograph_is_refused(tmp_path):
    folder = write_black(tmp_path, 1)
    for name in ("1.jpg", "2.jpg"):
        copyfile(folder / "0.jpg", folder / name)
    with pytest.raises(InputError, match=naming("1.jpg (of 0.jpg)", "found 1 ")):
        leave_copies_out(folder, find_photos(folder))


def test_the_same_photograph_with_another_mask_is_no_copy(tmp_path):
    folder = write_black(tmp_path, 3)
    copyfile(folder / "0.jpg", folder / "3.jpg")
    photos = find_photos(folder)
    masked = [photo if photo.name != "3.jpg" else type(photo)(**{**photo.__dict__, "mask": object()}) for photo in photos]
    assert not find_copies(folder, masked)
