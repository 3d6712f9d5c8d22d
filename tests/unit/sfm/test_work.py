"""The hidden folder in which a capture is made: atomic publication, continuation after a kill, one process at a time."""

from contextlib import suppress

import pytest

from scene_experts.core.errors import InputError
from scene_experts.core.io import write_json
from scene_experts.sfm import work
from support.messages import naming


def made(desk, text):
    for name in work.PLACES:
        path = desk / work.DONE / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if "." in name:
            path.write_text(text)
        else:
            path.mkdir()
            (path / "file").write_text(text)


def there(out):
    return [(out / place).read_text() if "." in name else (out / place / "file").read_text() for name, place in work.PLACES.items()]


def test_results_replace_earlier_ones(tmp_path):
    for text in ("old", "new"):
        with work.open_work_folder(tmp_path) as desk:
            made(desk, text)
            (desk / "database").mkdir()
            work.publish(tmp_path)
        assert there(tmp_path) == [text] * 3
    assert [p.name for p in (tmp_path / work.NAME).iterdir()] in ([], [".lock"])


@pytest.mark.parametrize("moves", range(7))
def test_a_publication_killed_between_any_two_moves_continues(tmp_path, monkeypatch, moves):
    with work.open_work_folder(tmp_path) as desk:
        made(desk, "old")
        work.publish(tmp_path)
        made(desk, "new")
        rename, left = type(tmp_path).rename, [moves]

        def some(self, target):
            if left[0] == 0:
                raise KeyboardInterrupt
            left[0] -= 1
            return rename(self, target)

        monkeypatch.setattr(type(tmp_path), "rename", some)
        with suppress(KeyboardInterrupt):
            work.publish(tmp_path)
        monkeypatch.undo()
    with work.open_work_folder(tmp_path):
        assert there(tmp_path) == ["new"] * 3


def test_incomplete_results_are_not_published(tmp_path):
    with work.open_work_folder(tmp_path) as desk:
        made(desk, "half")
    with work.open_work_folder(tmp_path):
        assert not (tmp_path / "images").exists()


def test_one_process_at_a_time(tmp_path):
    with work.open_work_folder(tmp_path), pytest.raises(InputError, match=naming(tmp_path)), work.open_work_folder(tmp_path):
        pass


def test_a_call_that_wrote_nothing_leaves_no_folder(tmp_path):
    out = tmp_path / "new"
    with pytest.raises(ValueError), work.open_work_folder(out):
        raise ValueError
    assert not out.exists()
    with pytest.raises(ValueError), work.open_work_folder(out) as folder:
        (folder / "database").mkdir()
        raise ValueError
    assert (folder / "database").is_dir()  # to continue from


def test_files_of_the_user_stay(tmp_path):
    for again in (False, True):
        with work.open_work_folder(tmp_path) as desk:
            done = desk / work.DONE
            (done / "images/a").mkdir(parents=True)
            (done / "model").mkdir()
            for name in ("images/a/1.jpg", "images/a/1_mask.png", "model/points3D.bin") + (() if again else ("images/2.jpg",)):
                (done / name).write_text("new" if again else "old")
            files = sorted(p.relative_to(done / "images").as_posix() for p in (done / "images").rglob("*") if p.is_file())
            write_json(done / "capture.json", {work.FILES: files})
            work.publish(tmp_path)
        if not again:
            for name in ("images/2_mask.png", "images/notes.txt", "images/extra.jpg", "sparse/0/test.txt"):
                (tmp_path / name).write_text("mine")
    for name in ("images/2_mask.png", "images/notes.txt", "images/extra.jpg", "sparse/0/test.txt"):
        assert (tmp_path / name).read_text() == "mine"
    for name in ("images/a/1.jpg", "images/a/1_mask.png", "sparse/0/points3D.bin"):
        assert (tmp_path / name).read_text() == "new"
    assert not (tmp_path / "images/2.jpg").exists()


def test_masks_stay_where_a_capture_has_no_list_of_its_copies(tmp_path):
    old, new = tmp_path / "old", tmp_path / "new"
    (old / "b").mkdir(parents=True)
    for name in ("1.jpg", "b/1_mask.png", "notes.txt"):
        (old / name).write_text("")
    work.keep_others(old, new, work.is_copy)
    assert sorted(p.relative_to(new).as_posix() for p in new.rglob("*") if p.is_file()) == ["b/1_mask.png", "notes.txt"]
