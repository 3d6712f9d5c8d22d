"""`download` and `catalog` from their flags, and a downloaded scene as a capture to train on."""

from __future__ import annotations

import io
import json
import shlex
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

import scene_experts as se
from scene_experts import cli
from scene_experts.commands import catalog as command
from scene_experts.commands.train import parse_train
from scene_experts.data.fetch import download, obtain
from scene_experts.data.fetch.catalog import SCENES, one
from scene_experts.data.settings import Data
from scene_experts.training import run_folder
from support.archives import in_folder, read_tree, write_tar
from support.synthetic import make_capture
from support.web import Server, serving


@pytest.fixture
def captures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(obtain.VARIABLE, str(tmp_path / "captures"))
    monkeypatch.setattr(download, "PATIENCE", 0.0)
    return tmp_path / "captures"


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    """Serves BungeeNeRF, whose rome is a small capture made in code."""
    folder = make_capture(tmp_path / "made", views=9, size=(48, 32)).folder
    with serving() as running:
        archive = write_tar(tmp_path / "x.tar.gz", in_folder("bungeenerf/rome", read_tree(folder)))
        running.files["/bungeenerf.tar.gz"] = archive.read_bytes()
        yield running


def test_a_scene_from_its_source_to_a_trained_run(
    captures: Path, server: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["download", "rome", "--mirror", server.url]) == 0
    out = capsys.readouterr().out
    assert "scene-experts train moe-gs --data catalog:rome --out RUN" in out and "rome: " in out
    assert cli.main(["info", "catalog:rome"]) == 0
    assert "9" in capsys.readouterr().out
    flags = ["--iterations", "2", "--rasterizer", "reference", "--device", "cpu", "--preview-every", "0"]
    assert cli.main(["train", "moe-gs", "--data", "catalog:bungeenerf/rome", "--out", str(tmp_path / "run"), *flags]) == 0
    config = run_folder.read_config(tmp_path / "run")
    data = config.data
    assert data == Data(captures / "bungeenerf" / "rome", resolution="as-is", split="mod8", normalise="none")
    assert (config.train.scene.voxel_rule, config.train.growth.init_factor) == ("squared_median", 128)
    assert json.loads((data.path / "source.json").read_text())["data_set"] == "BungeeNeRF"


def test_every_command_reads_a_scene_alike(
    captures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    make_capture(captures / "tandt" / "truck", views=5, size=(24, 16), points=120, scale=3.0)
    plan = ["blocks", "plan", "catalog:truck", "--out", str(tmp_path / "plan"), "--blocks", "2", "--recipe", "scaffold-gs"]
    for given in ([], ["--normalise", "extent"]):
        assert cli.main([*plan, *given]) == 0
        trains = [line for line in (tmp_path / "plan/commands.sh").read_text().splitlines() if " train " in line]
        found = [parse_train(shlex.split(line)[2:]) for line in trains]
        assert len(found) == 4 and {f.data.normalise for f in found} == {given[-1] if given else "none"}
        assert {f.cfg.scene.voxel_size for f in found} == {0.01} and {str(f.data.path) for f in found} == {"catalog:truck"}
    capsys.readouterr()
    assert cli.main(["info", "catalog:truck"]) == 0
    assert "--data catalog:truck " in capsys.readouterr().out
    capture = se.load_capture("catalog:truck")
    assert capture.loaded.world.identity and ("scene.voxel_size", 0.01) in capture.numbers
    for where in ("catalog:truck", capture):
        assert se.Trainer("scaffold-gs", where).recipe.scene.voxel_size == 0.01
    assert se.Trainer(se.recipe("scaffold-gs"), capture).recipe.scene.voxel_size == 0  # a recipe is used as it is
    assert se.Trainer("scaffold-gs", capture.path).recipe.scene.voxel_size == 0
    asked = []
    monkeypatch.setattr("scene_experts.files.importing.import_files", lambda source, data, out, *_: asked.append(data))
    monkeypatch.setattr("scene_experts.training.run_folder.read_config", lambda out: SimpleNamespace(data=asked[-1]))
    assert cli.main(["import", "a.ply", "--data", "catalog:truck", "--out", str(tmp_path / "imported")]) == 0
    assert asked == [capture.data]


def test_another_folder_is_named_in_the_next_step(
    captures: Path, server: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    to = tmp_path / "elsewhere"
    assert cli.main(["download", "rome", "--to", str(to), "--mirror", server.url, "--no-keep-archives"]) == 0
    said = capsys.readouterr().out
    assert f"--data {to / 'bungeenerf' / 'rome'} --resolution as-is --split mod8 --normalise none --scene.voxel-rule squared_median" in said
    assert not captures.exists() and [p.name for p in (to / "archives").iterdir()] == ["checksums.json"]


def test_the_table_and_the_particulars(captures: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("images", "sparse"):
        (captures / "tandt" / "truck" / name).mkdir(parents=True)
    assert cli.main(["catalog"]) == 0
    lines = capsys.readouterr().out.splitlines()
    rows = {line.split()[0]: line.split() for line in lines[1:18]}
    assert len(rows) == 17 and rows["truck"][-3:] == ["as-is", "mod8", "yes"] and rows["bonsai"][-2:] == ["inria:2", "mod8"]
    assert set(rows) == {scene.name for scene in SCENES}  # whole, also in a narrow terminal
    assert any("non-commercial" in line for line in lines) and str(captures) in lines[-1]
    assert cli.main(["catalog", "quebec", "truck"]) == 0
    out = capsys.readouterr().out
    assert str(captures / "archives" / "bungeenerf.tar.gz") in out and "scene-experts download quebec" in out
    assert "(downloaded)" in out and "816e62f2" in out and "first:31" in out
    assert cli.main(["download", "--list", "db"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == ["scene", "drjohnson", "playroom"]


def test_bad_words(captures: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["download", "bonsay"]) == 2
    assert "'bonsai'" in capsys.readouterr().err
    assert cli.main(["download"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert cli.main(["info", "catalog:bonsai"]) == 2
    assert "`scene-experts download bonsai`" in capsys.readouterr().err


def test_progress_with_and_without_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "SAY_EVERY", -1.0)
    plain = Console(file=io.StringIO(), width=120)
    with command.DownloadBar(plain) as told:
        told("360_v2.zip", 5_000_000, 0)
        told("360_v2.zip", 5_000_000, 10_000_000)
    assert plain.file.getvalue().splitlines() == ["360_v2.zip: 5 of ? MB", "360_v2.zip: 5 of 10 MB"]
    screen = Console(file=io.StringIO(), force_terminal=True, width=120, highlight=False)
    with command.DownloadBar(screen) as told:
        told("unpacking truck", 5, 10)
        told.say("a [word] as it is")
    assert "unpacking truck" in screen.file.getvalue() and "a [word] as it is" in screen.file.getvalue()


def test_flags_of_a_scene() -> None:
    assert command.flags(one("garden"), None) == "--data catalog:garden"
    said = command.flags(one("garden"), Path("d"))
    assert said == "--data d/mipnerf360/garden --resolution inria:4 --split mod8 --normalise none --scene.voxel-size 0.001"
    assert command.flags(one("garden"), Path("my d")).startswith("--data 'my d/mipnerf360/garden' ")
