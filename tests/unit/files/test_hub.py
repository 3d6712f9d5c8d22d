"""The folder for a model hub: what hubs read in its card, and its files."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from PIL import Image

from scene_experts.commands.files import export
from scene_experts.core.errors import InputError
from scene_experts.data import capture as captures
from scene_experts.data.settings import Data
from scene_experts.files import hub
from scene_experts.files.standard import Written
from scene_experts.render import choose
from scene_experts.training import loop, run_folder
from scene_experts.training.config import RunConfig
from scene_experts.training.recipes import RECIPES
from support.synthetic import make_capture


def front_matter(card):
    _, head, body = card.split("---\n", 2)
    return yaml.safe_load(head), body


def test_the_card_states_licence_tags_scores_and_files(tmp_path):
    train = SimpleNamespace(recipe="moe-gs")
    run = SimpleNamespace(config=SimpleNamespace(train=train, data=SimpleNamespace(path=tmp_path / "banana")), step=2000)
    run.scene = SimpleNamespace(traits=SimpleNamespace(rows="anchors"))
    files = [Written(tmp_path / "scene.compact", 3_000_000, 400, (), "compact"), Written(tmp_path / "scene.spz", 900_000, 4000, (), "spz")]
    scores = {"psnr": 27.25, "ssim": 0.9, "lpips": None, "view_count": 2, "split": "mod8", "resolution": "longest:800"}
    head, body = front_matter(hub.make_card(run, files, scores, "mit", ["CAPTURE_LICENSE"]))  # type: ignore[arg-type]
    assert head["license"] == "mit" and {"gaussian-splatting", "moe-gs"} <= set(head["tags"])
    metrics = head["model-index"][0]["results"][0]["metrics"]
    assert {m["type"]: m["value"] for m in metrics} == {"psnr": 27.25, "ssim": 0.9}
    for fact in (
        "scene.compact",
        "scene.spz",
        hub.PREVIEW,
        "scene-experts import",
        "2 held-out views",
        "400 anchors",
        "4,000 Gaussians",
        "CAPTURE_LICENSE",
        "2,000",
    ):
        assert fact in body
    fitted = {**scores, "alignment": "held-out cameras aligned with the frozen scene"}
    for text in (body, hub.make_card(run, files, fitted, "mit", [])):  # type: ignore[arg-type]
        assert text.count("cameras fitted to these photographs") == (0 if text == body else 2)
    head, body = front_matter(hub.make_card(run, files, {}, hub.UNKNOWN, []))  # type: ignore[arg-type]
    assert "model-index" not in head and head["license"] == "unknown" and "not stated" in body


def test_the_card_names_a_result_folder_and_offers_no_import_that_would_be_refused(tmp_path):
    config = SimpleNamespace(train=SimpleNamespace(recipe="moe-gs"), data=SimpleNamespace(path=tmp_path / "banana"))
    run = SimpleNamespace(config=config, step=40, scene=SimpleNamespace(traits=SimpleNamespace(rows="anchors")))
    folder = tmp_path / "point_cloud" / "iteration_40"
    folder.mkdir(parents=True)
    card = hub.make_card(run, [Written(folder, 3_000_000, 400, (), "anchors")], {}, "mit", [])  # type: ignore[arg-type]
    assert "| `point_cloud/iteration_40` | 400 anchors with their networks" in card and "scene-experts import . --data" in card
    spz = [Written(tmp_path / "scene.spz", 900_000, 4000, (), "spz")]
    card = hub.make_card(run, spz, {}, "mit", [], imports=False)  # type: ignore[arg-type]
    assert "scene-experts import" not in card and "trained in" in card and "`.spz`" in card


def test_the_card_says_what_pages_and_meshes_hold_and_imports_what_can_be_read(tmp_path):
    config = SimpleNamespace(train=SimpleNamespace(recipe="moe-gs"), data=SimpleNamespace(path=tmp_path / "banana"))
    run = SimpleNamespace(config=config, step=40, scene=SimpleNamespace(traits=SimpleNamespace(rows="anchors")))
    mesh = Written(tmp_path / "scene.mesh.ply", 900_000, 4000, (), "mesh")
    page = Written(tmp_path / "scene.html", 900_000, 400, (), "streamed-html")
    card = hub.make_card(run, [mesh, page], {}, "mit", [])  # type: ignore[arg-type]
    assert "`scene.mesh.ply` | a mesh" in card and "`scene.html`, `scene.parts` | 400 anchors with their networks" in card
    assert "import scene.html --data" in card
    assert "import" not in hub.make_card(run, [mesh], {}, "mit", [])  # type: ignore[arg-type]


def test_scores_are_those_of_the_iteration_that_is_written(tmp_path, caplog):
    run = SimpleNamespace(path=tmp_path, step=2000)
    assert hub.find_scores(run) == {}  # type: ignore[arg-type]
    for scores in ({"psnr": 27.0, "step": 2000}, {"psnr": 27.0}):
        (tmp_path / "results.json").write_text(json.dumps(scores))
        assert hub.find_scores(run) == scores and not caplog.records  # type: ignore[arg-type]
    (tmp_path / "results.json").write_text(json.dumps({"psnr": 27.0, "step": 1500}))
    assert hub.find_scores(run) == {}  # type: ignore[arg-type]
    assert all(fact in caplog.text for fact in ("1500", "2000", f"eval {tmp_path} --step 2000"))


def test_licence_texts_are_copied(tmp_path):
    (tmp_path / "capture").mkdir()
    (tmp_path / "capture" / "LICENSE").write_text("MIT")
    (tmp_path / "capture" / "ATTRIBUTION.txt").write_text("by A")
    (tmp_path / "capture" / "photo.txt").write_text("no")
    assert hub.copy_notices(tmp_path / "capture", tmp_path) == ["CAPTURE_ATTRIBUTION.txt", "CAPTURE_LICENSE"]
    assert (tmp_path / "CAPTURE_LICENSE").read_text() == "MIT"


def test_flags_that_do_not_fit_are_refused(tmp_path):
    with pytest.raises(InputError, match="--hub"):
        export([str(tmp_path), "--hub", str(tmp_path / "hub"), "--out", str(tmp_path / "a.spz")])
    with pytest.raises(InputError, match="--licence"):
        export([str(tmp_path), "--licence", "mit"])
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="--hub"):
        hub.write_hub(None, tmp_path / "file")  # type: ignore[arg-type]
    (tmp_path / hub.CARD).write_text("my own words")
    with pytest.raises(InputError, match=r"README\.md"):
        hub.write_hub(None, tmp_path)  # type: ignore[arg-type]
    assert (tmp_path / hub.CARD).read_text() == "my own words"


@pytest.mark.slow
def test_the_command_writes_a_folder(tmp_path, capsys):
    folder = make_capture(tmp_path / "capture", views=9, size=(48, 32), points=250).folder
    (folder / "LICENSE").write_text("MIT")
    config = RunConfig(replace(RECIPES["moe-gs"][1], iterations=300), Data(folder), stop_at=10)
    run_folder.prepare(tmp_path / "run", config, resume=False)
    capture = captures.load(config.data)
    list(loop.train(config.train, loop.Job(config, tmp_path / "run"), capture, choose("auto", "cpu")))
    capture.images.close()
    out = tmp_path / "hub"
    assert export([str(tmp_path / "run"), "--hub", str(out), "--refine", "2", "--no-measure", "--licence", "mit"]) == 0
    assert "README.md" in capsys.readouterr().out
    assert {"README.md", "preview.png", "scene.compact", "scene.spz", "CAPTURE_LICENSE"} <= {p.name for p in out.iterdir()}
    head, body = front_matter((out / "README.md").read_text())
    assert head["license"] == "mit" and "CAPTURE_LICENSE" in body
    picture = np.asarray(Image.open(out / "preview.png"))
    assert picture.shape == (32, 48, 3) or picture.ndim == 3
    assert picture.std() > 1
