"""Scenes of files: what is refused, in one sentence, and what a run folder is."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest

from scene_experts.core.errors import InputError
from scene_experts.files.export import Options, export
from scene_experts.files.formats import ply
from scene_experts.files.lone import name_of, open_scene
from support.messages import naming
from support.splats import splats


@pytest.fixture
def file(tmp_path: Path) -> Path:
    ply.write(tmp_path / "garden.ply", splats(50), {})
    return tmp_path / "garden.ply"


def test_files_go_beside_it_and_not_over_others(file: Path) -> None:
    (made,) = export(open_scene(file), "spz")
    assert made.path == file.with_name("garden.spz")
    export(open_scene(file), "spz")  # our own may be replaced
    file.with_name("garden.sog").write_bytes(b"a present")
    with pytest.raises(InputError, match=naming("--out")):
        export(open_scene(file), "sog")
    with pytest.raises(InputError, match=naming("--out")):
        export(open_scene(file), "ply")


def test_what_needs_photographs_is_refused(file: Path) -> None:
    with pytest.raises(InputError, match=naming("--data")):
        export(open_scene(file), "spz", options=Options(floaters="remove"))
    with pytest.raises(InputError, match="--format ply"):
        export(open_scene(file), "compact")
    with pytest.raises(InputError, match="name one with --out"):
        export(open_scene(file), "anchors")


def test_what_is_no_scene_is_refused(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "absent.ply"):
        with pytest.raises(InputError, match=r"expected a run folder .* or a file"):
            open_scene(path)


@pytest.mark.parametrize("name", ["a.b.ply", "a.b.compressed.ply", "a.b.zip", "a.b.sog"])
def test_the_name_of_a_scene(tmp_path: Path, name: str) -> None:
    assert name_of(tmp_path / name) == "a.b"


def test_zips_and_folders_of_sog_are_files_too(file: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "mail.zip", "w") as archive:
        archive.write(file, "garden.ply")
    (made,) = export(open_scene(tmp_path / "mail.zip"), "sog", tmp_path / "a.sog")
    with zipfile.ZipFile(made.path) as archive:
        archive.extractall(tmp_path / "folder")
    (page,) = export(open_scene(tmp_path / "folder"), "html", tmp_path / "pages")
    assert page.path == tmp_path / "pages/folder.html" and page.rows == 50


def test_the_folder_of_make_names_its_run(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.json").touch()
    with pytest.raises(InputError, match=naming(f"give the run {tmp_path / 'run'}")):
        open_scene(tmp_path)
    with pytest.raises(InputError, match="check the path"):
        open_scene(tmp_path / "nothing")
