"""The hidden folder in which a capture is made: atomic publication, continuation after a kill, one process at a time."""

from contextlib import suppress

import pytest

from scene_experts.core.errors import InputError
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
