"""A run folder: what may be written into one, what is kept, and how a run is opened again."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from scene_experts.core import checkpoint
from scene_experts.core.errors import InputError
from scene_experts.data import capture as captures
from scene_experts.data.settings import Data
from scene_experts.training import run_folder
from scene_experts.training.config import RunConfig
from scene_experts.training.recipes import RECIPES
from scene_experts.training.state import Training
from support.captures import load
from support.messages import naming
from support.synthetic import make_capture

CFG = replace(RECIPES["moe-gs"][1], iterations=300)
CONFIG = RunConfig(CFG, Data(Path("capture").absolute()))


def test_points_inside_the_capture_move_with_it(tmp_path, monkeypatch):
    (tmp_path / "box").mkdir()
    for path in ("box/inside.ply", "outside.ply"):
        (tmp_path / path).touch()
    monkeypatch.chdir(tmp_path)
    box = Path("box")
    for given, settled in (
        (box / "inside.ply", Path("inside.ply")),
        (tmp_path / "box/inside.ply", Path("inside.ply")),
        (Path("inside.ply"), Path("inside.ply")),
        (Path("outside.ply"), tmp_path / "outside.ply"),
    ):
        assert run_folder.named(Data(box, points=given)).points == settled
        assert run_folder.named(Data(box, points=settled)).points == settled


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Training:
    capture = load(make_capture(tmp_path_factory.mktemp("capture"), views=4, size=(24, 16), points=60).folder)
    capture.images.close()
    return Training.start(CFG.scaled(), capture, "cpu")


@pytest.fixture
def run(trained, tmp_path) -> Path:
    """A run with checkpoints at 10 and 20."""
    run_folder.prepare(tmp_path, CONFIG, resume=False)
    for step in (10, 20):
        trained.step = step
        checkpoint.save(tmp_path / "checkpoints", step, trained.tensors(), trained.meta())
    return tmp_path


def state(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_the_configuration_comes_back(run):
    assert run_folder.read_config(run) == CONFIG
    assert run_folder.versions().keys() == {"scene-experts", "torch", "python", "machine"}


def test_a_run_opens_at_its_newest_or_a_chosen_checkpoint(run, trained):
    opened = run_folder.open_run(run)
    assert (opened.step, opened.config, opened.path) == (20, CONFIG, run)
    for name, value in trained.scene.network_tensors().items():
        assert torch.equal(opened.scene.network_tensors()[name], value)
    assert run_folder.open_run(run, step=10).step == 10
    with pytest.raises(InputError, match=naming(15, "10, 20")):
        run_folder.open_run(run, step=15)


def test_a_damaged_checkpoint_is_passed_over_and_said_of(run, caplog):
    newest = run / "checkpoints" / "ckpt_000020.safetensors"
    newest.write_bytes(newest.read_bytes()[:-10])
    assert run_folder.open_run(run).step == 10 and "ckpt_000020" in caplog.text
    with pytest.raises(InputError, match="ckpt_000020"):
        run_folder.open_run(run, step=20)
    (run / "checkpoints" / "ckpt_000010.safetensors").write_bytes(b"")
    with pytest.raises(InputError, match=naming(run / "checkpoints")):
        run_folder.open_run(run)
    (run / "checkpoints" / "ckpt_000010.safetensors").unlink()
    newest.unlink()
    with pytest.raises(InputError, match=naming(run / "checkpoints")):
        run_folder.open_run(run)


def test_a_capture_that_is_not_here_is_asked_for_by_its_flag(run, tmp_path, monkeypatch):
    folder = make_capture(tmp_path / "home" / "capture", views=3).folder
    monkeypatch.chdir(tmp_path)
    for path, said in (
        (folder / "absent", "absent"),
        (Path("capture"), "capture"),
    ):
        opened = run_folder.open_run(run)
        opened = replace(opened, config=replace(opened.config, data=Data(path)))
        with pytest.raises(InputError, match=naming(said, "--data")):
            run_folder.capture_of(opened)
        assert run_folder.capture_of(opened, folder).root == folder
    with pytest.raises(InputError, match="nowhere"):
        run_folder.capture_of(opened, tmp_path / "nowhere")
    monkeypatch.chdir(tmp_path / "home")
    found = run_folder.capture_of(opened)
    assert found.root == Path("capture")
    assert run_folder.capture_of(replace(opened, capture=found.fingerprint())).root == Path("capture")
    with pytest.raises(InputError, match=naming("capture", "--data")):
        run_folder.capture_of(replace(opened, capture="of other views"))
    assert run_folder.capture_of(replace(opened, poses=found.poses())).root == Path("capture")
    make_capture(tmp_path / "home" / "capture", views=3, scale=2.0)  # as `capture --overwrite` may do
    with pytest.raises(InputError, match=naming(run, "capture", "--overwrite")):
        run_folder.capture_of(replace(opened, capture=found.fingerprint(), poses=found.poses()))


def test_a_checkpoint_of_another_recipe_in_the_folder(run):
    run_folder.write_json(run / "config.json", json.loads((run / "config.json").read_text().replace('"moe-gs"', '"scaffold-gs"')))
    with pytest.raises(InputError, match=naming("scaffold-gs", "moe-gs")):
        run_folder.open_run(run)


@pytest.mark.parametrize(
    ("config", "options", "facts"),
    [
        (CONFIG, {"resume": False}, ["--resume", "--overwrite"]),
        (CONFIG, {"resume": True, "overwrite": True}, ["--resume", "--overwrite"]),
        (RunConfig(RECIPES["scaffold-gs"][1], CONFIG.data), {"resume": True}, ["scaffold-gs", "moe-gs"]),
        (RunConfig(replace(CFG, iterations=600), CONFIG.data), {"resume": True}, ["iterations", 300, 600]),
        (RunConfig(replace(CFG, loss=replace(CFG.loss, load=0.5)), CONFIG.data), {"resume": True}, ["loss.load", 0.01, 0.5]),
        (RunConfig(CFG, replace(CONFIG.data, split="first:2")), {"resume": True}, ["split", "auto", "first:2"]),
        (RunConfig(CFG, replace(CONFIG.data, init="dense")), {"resume": True}, ["init", "auto", "dense"]),
        (RunConfig(replace(CFG, loss=replace(CFG.loss, load=float("nan"))), CONFIG.data), {"resume": False}, ["nan"]),
        (replace(CONFIG, init_from=Path("/coarse")), {"resume": True}, ["--init-from", "none", "/coarse"]),
    ],
)
def test_what_is_refused_changes_nothing(config, options, facts, run):
    before = state(run)
    for act in (run_folder.check, run_folder.prepare):
        with pytest.raises(InputError, match=naming(*facts)):
            act(run, config, **options)
        assert state(run) == before


def test_resuming_may_move_the_capture_and_the_stop(run):
    moved = RunConfig(CFG, replace(CONFIG.data, path=Path("elsewhere").absolute()), stop_at=100)
    run_folder.check(run, moved, resume=True)
    assert run_folder.read_config(run) == CONFIG, "checking writes nothing"
    run_folder.prepare(run, moved, resume=True)
    assert run_folder.read_config(run) == moved and checkpoint.latest(run / "checkpoints") is not None


def test_a_run_that_memory_limited_in_one_part_is_a_limited_run(run):
    run_folder.prepare(run, replace(CONFIG, max_memory=2.0), resume=False, overwrite=True)
    (run / "checkpoints").mkdir(exist_ok=True)
    run_folder.prepare(run, CONFIG, resume=True)
    assert run_folder.read_config(run).max_memory == 2.0


def test_a_resumed_run_has_one_start_and_is_deterministic_as_a_whole(run):
    begun = replace(CONFIG, init_from=run / "coarse", deterministic=True)
    run_folder.prepare(run, begun, resume=False, overwrite=True)
    for same in (begun, replace(begun, init_from=run / ".." / run.name / "coarse"), replace(begun, init_from=None)):
        run_folder.check(run, same, resume=True)
    with pytest.raises(InputError, match=naming("--init-from", run / "coarse", run / "other")):
        run_folder.check(run, replace(begun, init_from=run / "other"), resume=True)
    for given in (True, False, True):
        run_folder.prepare(run, replace(begun, deterministic=given), resume=True)
    assert not run_folder.read_config(run).deterministic


def test_a_run_is_not_written_over_the_run_that_it_starts_from(run):
    before, config = state(run), replace(CONFIG, init_from=run / ".." / run.name)
    with pytest.raises(InputError, match=naming("--init-from", run, "--out")):
        run_folder.prepare(run, config, resume=False, overwrite=True)
    assert state(run) == before


def test_overwriting_removes_what_belonged_to_the_old_run_and_nothing_else(run):
    (run / "previews").mkdir()
    for kind in ("renders", "experts"):
        (run / "test" / kind).mkdir(parents=True)
    exported = [
        "scene.compact",
        "scene.ply.json",
        "test/renders/1.png",
        "test/experts/cov.png",
    ]
    mine = ["notes.txt", "scene.blend", "scenery.ply"]
    for name in (*exported, *mine, "results.json", "per_view_train.json", "report.html", "metrics.jsonl", "previews/000030.png"):
        (run / name).write_text("old")
    for name in ("iteration_20/scene.json", "iteration_7/mine.txt"):
        (run / "point_cloud" / name).parent.mkdir(parents=True)
        (run / "point_cloud" / name).write_text("old")
    other = RunConfig(RECIPES["scaffold-gs"][1], CONFIG.data)
    run_folder.check(run, other, resume=False, overwrite=True)
    assert len(state(run)) == 17
    run_folder.prepare(run, other, False, True, exported=[run / "scene.compact", run / "scene.ply.json"])
    assert state(run).keys() == {"config.json", *mine, "point_cloud/iteration_7/mine.txt"} and run_folder.read_config(run) == other


@pytest.mark.parametrize("overwrite", [False, True])
def test_folders_of_somebody_else_are_left_alone(tmp_path, overwrite):
    capture = tmp_path / "capture"
    (capture / "test").mkdir(parents=True)
    (capture / "test" / "r_0.png").write_text("a photograph")
    (tmp_path / "project" / "train").mkdir(parents=True)
    for name in ("config.json", "report.html", "train/notes.txt"):
        (tmp_path / "project" / name).write_text("{}")
    before = state(tmp_path)
    config = replace(CONFIG, data=Data(capture))
    with pytest.raises(InputError, match=naming(capture)):
        run_folder.prepare(capture, config, resume=False, overwrite=overwrite)
    for folder, found in (("project", "config.json"), ("capture", "test")):
        with pytest.raises(InputError, match=naming(tmp_path / folder, found)):
            run_folder.prepare(tmp_path / folder, CONFIG, resume=False, overwrite=overwrite)
    assert state(tmp_path) == before


def test_places_that_cannot_be_a_run_folder(tmp_path):
    (tmp_path / "file").write_text("x")
    for place in (tmp_path / "file", tmp_path / "file" / "below" / "it"):
        with pytest.raises(InputError, match=naming(tmp_path / "file")):
            run_folder.prepare(place, CONFIG, resume=False, overwrite=True)
    with pytest.raises(InputError, match="--resume"):
        run_folder.prepare(tmp_path / "new", CONFIG, resume=True)
    assert not (tmp_path / "new").exists() and (tmp_path / "file").read_text() == "x"


def test_a_path_that_checkpoints_could_not_be_read_from_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"UTF-8.*caf\\udce9.*--out"):
        run_folder.check(tmp_path / "caf\udce9", CONFIG, resume=False)


def test_one_training_holds_a_run_folder(tmp_path):
    with run_folder.held(tmp_path / "run"):
        with pytest.raises(InputError, match=naming(tmp_path / "run")), run_folder.held(tmp_path / "run"):
            pass
        with run_folder.held(tmp_path / "other"):
            pass
    with run_folder.held(tmp_path / "run"):
        pass


@pytest.mark.parametrize(
    "text",
    ["{", "[]", '{"format": 99}', "{}", '{"format": 1}'],
)
def test_a_damaged_or_foreign_configuration(tmp_path, text):
    (tmp_path / "config.json").write_text(text)
    with pytest.raises(InputError, match="config"):
        run_folder.read_config(tmp_path)


def test_a_capture_is_read_as_the_run_says(tmp_path):
    make_capture(tmp_path, views=6, size=(24, 16), points=60)
    capture = captures.load(Data(tmp_path, resolution="factor:2", split="first:2", background=(1.0, 0.0, 0.5), init="random"), 3)
    assert capture.views[0].camera.width == 12 and capture.test == (0, 1) and capture.background == (1.0, 0.0, 0.5)
    assert capture.points is not None and len(capture.points.xyz) == 10_000
    capture.images.close()
    for wrong in ((0.0, 0.0, 2.0), (float("nan"), 0.0, 0.0)):
        with pytest.raises(InputError, match="--background"):
            captures.load(Data(tmp_path, background=wrong))


def test_near_of_the_users_choice(tmp_path):
    folder = make_capture(tmp_path, views=4, size=(24, 16), points=60).folder
    for near, expected in ((None, 0.1), (0.03, 0.03)):
        capture = captures.load(Data(folder, near=near))
        capture.images.close()
        assert {round(v.camera.near, 6) for v in capture.views} == {expected}
    with pytest.raises(InputError, match="--near"):
        captures.load(Data(folder, near=0.0))


@pytest.mark.parametrize("command", ["import scene.ply", "merged from 2 blocks"])
def test_an_import_over_another_run_is_not_told_to_resume(command, tmp_path):
    (tmp_path / "checkpoints").mkdir(parents=True)
    (tmp_path / "checkpoints" / "ckpt_000001.safetensors").write_bytes(b"")
    with pytest.raises(InputError, match="--out") as error:
        run_folder.check(tmp_path, replace(CONFIG, command=command), resume=False)
    assert "--resume" not in str(error.value)


def test_a_training_killed_before_its_configuration_was_written_can_be_started_again(tmp_path):
    (tmp_path / ".lock").touch()
    (tmp_path / ".config.json.abc.part").write_bytes(b"{")
    run_folder.prepare(tmp_path, CONFIG, resume=False)
    assert run_folder.read_config(tmp_path) == CONFIG and not list(tmp_path.glob("*.part"))
