"""Files of a folder of photographs, without what programs wrote there."""

import pytest

from scene_experts.core.errors import InputError
from scene_experts.sfm.folders import list_files
from scene_experts.sfm.photos import find_photos
from support.messages import naming
from support.photos import write_photo

RESULTS = {
    "a capture": ("capture.json", "images/1.jpg"),
    "an unfinished capture": (".capture/log", "images/1.jpg"),
    "a scene of make": ("source.json", "capture/images/1.jpg"),
    "a run": ("config.json", "checkpoints/x", "test/renders/1.jpg"),
    "a run of another program": ("cfg_args", "point_cloud/x", "test/gt/1.jpg"),
    "a SOG": ("meta.json", "means_l.webp"),
}


@pytest.mark.parametrize("files", RESULTS.values(), ids=RESULTS)
def test_results_in_the_folder_are_no_photographs_and_are_told(tmp_path, files):
    for name in ("1.jpg", "2.jpg", "more/3.jpg"):
        write_photo(tmp_path / name)
    for name in files:
        place = tmp_path / "more" / "result" / name
        place.parent.mkdir(parents=True, exist_ok=True)
        write_photo(place) if name.endswith((".jpg", ".webp")) else place.write_text("{}")
    told = []
    assert [photo.name for photo in find_photos(tmp_path, say=told.append)] == ["1.jpg", "2.jpg", "more/3.jpg"]
    assert "more/result/" in told[0]


def test_what_was_left_out_is_told_where_too_few_photographs_remain(tmp_path):
    for i in range(3):
        write_photo(tmp_path / "sub" / "images" / f"{i}.jpg")
    (tmp_path / "sub" / "capture.json").write_text("{}")
    told = []
    with pytest.raises(InputError, match=naming(3, 0)):
        find_photos(tmp_path, say=told.append)
    assert len(told) == 1 and "sub/" in told[0]


def test_the_folder_that_was_named_is_looked_at_whatever_it_holds(tmp_path):
    for name in ("1.jpg", "2.jpg", "3.jpg"):
        write_photo(tmp_path / "images" / name)
    (tmp_path / "capture.json").write_text("{}")
    assert len(list_files(tmp_path, None)) == 4 and len(find_photos(tmp_path / "images")) == 3


def test_links_are_followed_once_and_hidden_files_are_left_out(tmp_path):
    write_photo(tmp_path / "photos" / "1.jpg")
    write_photo(tmp_path / "photos" / ".trash" / "2.jpg")
    write_photo(tmp_path / "elsewhere" / "3.jpg")
    (tmp_path / "photos" / "link").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "photos" / "loop").symlink_to(tmp_path / "photos")
    assert sorted(path.name for path in list_files(tmp_path / "photos", None)) == ["1.jpg", "3.jpg"]
