"""A page from photographs: which stages run, with what, and what a repeated call does."""

import json
import signal
from dataclasses import asdict, replace
from shutil import copyfile, copytree
from types import SimpleNamespace

import pytest
import torch

from scene_experts.bench.advice import Advice
from scene_experts.core.errors import InputError
from scene_experts.making import budget, plan
from scene_experts.making import make as making
from scene_experts.making.make import make, name_source
from scene_experts.sfm.options import SfmOptions, SourceOptions
from scene_experts.training.events import Stepped
from scene_experts.training.recipes import PROPOSED
from support.messages import naming
from support.photos import write_black
from support.synthetic import make_capture


def stepped(step, seconds):
    return Stepped(step, {}, 25.0, 10, 10, 10, 1.0, seconds, {})


@pytest.fixture
def capture(tmp_path):
    return make_capture(tmp_path / "box", views=9, size=(48, 32), points=200).folder


@pytest.fixture
def trained(monkeypatch):
    """Trainings that take `seconds` an iteration and write nothing but a checkpoint's name; returns them."""
    made = []

    class Trainer:
        seconds = 0.01

        def __init__(self, recipe, capture, folder, resume, overwrite, preview_every, save_every):
            self.recipe, self.capture, self.folder, self.stopped = recipe, capture, folder, False
            self.resume, self.run = (
                resume,
                SimpleNamespace(evaluate=lambda lpips: SimpleNamespace(psnr=21.0), report=lambda: folder / "r.html"),
            )
            made.append(self)

        def __iter__(self):
            for step in range(10, self.recipe.iterations + 1, 10):
                yield stepped(step, step * self.seconds)
                if self.stopped:
                    return
            if not self.resume:
                (self.folder / "checkpoints").mkdir(parents=True, exist_ok=True)
                (self.folder / "checkpoints" / "ckpt_1.safetensors").touch()

        def stop(self, reason):
            self.stopped = True

    def export(opened, formats, page, options, tell):
        page.write_text(json.dumps({"title": options.title}))
        return [page]

    monkeypatch.setattr(making, "Trainer", Trainer)
    monkeypatch.setattr(making, "export_several", export)
    monkeypatch.setattr(making.run_folder, "open_run", lambda folder: None)

    def suggest(width, height, views, have, slow=1.0):
        iterations = 1000 if have is None or slow == 1 else round(have / slow * 10)
        return Advice(0, iterations, iterations / 1000)

    monkeypatch.setattr(plan, "plan_training", suggest)
    monkeypatch.setattr(plan, "measure_share", lambda threads: 1.0)
    return SimpleNamespace(made=made, Trainer=Trainer)


def test_all_photographs_are_trained_on_and_a_page_is_written(capture, tmp_path, trained):
    said = []
    made = make(capture, tmp_path / "out", say=said.append)
    (one,) = trained.made
    assert len(one.capture.train_cameras) == 9 and one.recipe.recipe == PROPOSED and one.recipe.iterations == 1000
    assert made.page == tmp_path / "out" / "scene.html" and json.loads(made.page.read_text()) == {"title": "box"}
    assert (
        made.report is None
        and made.psnr == 25.0
        and made.capture == capture
        and set(made.seconds) == {"poses", "training", "scores", "page"}
    )


def test_scores_are_those_of_photographs_held_out(capture, tmp_path, trained):
    made = make(capture, tmp_path / "out", scores=True, say=lambda _: None)
    assert len(trained.made[0].capture.test_cameras) == 2 and made.psnr == 21.0 and made.report is not None


def test_the_fewest_iterations_are_told(capture, tmp_path, trained, monkeypatch):
    monkeypatch.setattr(plan, "plan_training", lambda *_: Advice(0, budget.LEAST, 1.0))
    said = []
    make(capture, tmp_path / "out", minutes=1.0, say=said.append)
    assert any("300 iterations (the fewest; the time is too short for more), " in line for line in said)


def test_scores_of_too_few_photographs_are_refused_before_the_training(capture, tmp_path, trained, monkeypatch):
    given = plan.load_capture
    monkeypatch.setattr(plan, "load_capture", lambda place, split, **more: given(place, split="none", **more))
    with pytest.raises(InputError, match=r"for --scores, found 9, so few that all are trained on; leave --scores out"):
        make(capture, tmp_path / "out", scores=True, say=lambda _: None)
    assert not trained.made and not (tmp_path / "out" / "run").exists()


def test_scores_of_a_folder_with_too_few_photographs_are_refused_before_the_poses(tmp_path, trained, monkeypatch):
    monkeypatch.setattr(making, "reconstruct", lambda *_, **more: pytest.fail("poses were sought"))
    write_black(tmp_path / "photos", 11)
    with pytest.raises(InputError, match=r"at least 12 photographs for --scores, found 11"):
        make(tmp_path / "photos", tmp_path / "out", scores=True, say=lambda _: None)
    assert not (tmp_path / "out").exists()
    copyfile(tmp_path / "photos" / "0.jpg", tmp_path / "photos" / "copy.jpg")
    with pytest.raises(InputError, match=r"found 11"):
        make(tmp_path / "photos", tmp_path / "out", scores=True, say=lambda _: None)
    write_black(tmp_path / "photos", 12)
    making.check_enough(tmp_path / "photos", tmp_path / "out", SourceOptions())


def test_a_training_that_would_not_fit_begins_anew_with_other_iterations(capture, tmp_path, trained, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    trained.Trainer.seconds = 0.1  # 1,000 iterations would take 137 s with growth
    make(capture, tmp_path / "out", minutes=1.5, say=lambda _: None)
    first, second = trained.made
    assert first.stopped and not second.stopped
    assert second.recipe.iterations == pytest.approx(82 / (137 / 60) * 10, rel=0.02)  # 8 of 90 s are the page's; 137 s for 1 min


def test_the_same_training_is_not_begun_anew(capture, tmp_path, trained, monkeypatch):
    monkeypatch.setattr(plan, "plan_training", lambda *_: Advice(0, 1000, None))
    make(capture, tmp_path / "out", minutes=60.0, say=lambda _: None)
    assert len(trained.made) == 1


def test_a_repeated_call_continues_the_training_and_keeps_the_page(capture, tmp_path, trained, monkeypatch):
    made = make(capture, tmp_path / "out", say=lambda _: None)
    begun = SimpleNamespace(
        data=SimpleNamespace(path=capture, split="none", resolution="auto"), train=replace(trained.made[0].recipe, iterations=500)
    )
    (made.run / "config.json").touch()
    monkeypatch.setattr(plan.run_folder, "read_config", lambda folder: begun)
    made.page.write_text("mine")
    make(capture, tmp_path / "out", say=lambda _: None)
    assert trained.made[1].resume and trained.made[1].recipe.iterations == 500 and made.page.read_text() == "mine"
    with pytest.raises(InputError, match=naming(made.run)):
        make(capture, tmp_path / "out", scores=True, say=lambda _: None)


def test_photographs_get_poses_first(tmp_path, capture, trained, monkeypatch):
    asked = []

    def reconstruct(source, out, options, few, say, progress):
        asked.append((out, options))
        make_capture(out, views=9, size=(48, 32), points=200)
        (out / "capture.json").write_text(json.dumps({"options": asdict(options)}))
        return {"with_pose": 9, "photographs": 10, "points": 200, "without_pose": ["a.jpg"], "apart": [], "all_compared": True}

    monkeypatch.setattr(making, "reconstruct", reconstruct)
    (tmp_path / "photos").mkdir()
    said, options = [], SourceOptions(nadir=20.0)
    for _ in range(2):
        made = make(tmp_path / "photos", tmp_path / "out", options=options, say=said.append)
    assert asked == [(tmp_path / "out" / "capture", SfmOptions(nadir=20.0))] and made.capture == asked[0][0]
    assert "photographs without a pose: a.jpg" in said
    with pytest.raises(InputError, match=naming("--nadir 20.0")):
        make(tmp_path / "photos", tmp_path / "out", say=lambda _: None)
    (tmp_path / "others").mkdir()
    with pytest.raises(InputError, match=naming(tmp_path / "others", tmp_path / "photos")):
        make(tmp_path / "others", tmp_path / "out", say=lambda _: None)
    with pytest.raises(InputError, match=naming(tmp_path / "out" / "capture")):
        make(tmp_path / "out", tmp_path / "again", say=lambda _: None)


def test_photographs_that_changed_since_are_told_and_a_copy_of_them_goes_on(tmp_path, trained, monkeypatch):
    def reconstruct(source, out, *_, **more):
        make_capture(out, views=9, size=(48, 32), points=200)
        return {"with_pose": 9, "photographs": 9, "points": 200, "without_pose": [], "apart": [], "all_compared": True}

    monkeypatch.setattr(making, "reconstruct", reconstruct)
    photos, said = tmp_path / "photos", []
    photos.mkdir()
    for name in "abc":
        (photos / f"{name}.jpg").write_bytes(b"12")
    (photos / "notes.txt").touch()
    call = lambda source: make(source, tmp_path / "out", say=said.append)  # noqa: E731
    call(photos)
    copytree(photos, tmp_path / "moved")
    call(photos)
    call(tmp_path / "moved")
    (photos / "notes.txt").unlink()
    call(photos)
    assert not any("since then" in line for line in said)
    (photos / "a.jpg").unlink()
    (photos / "b.jpg").write_bytes(b"123")
    (photos / "d.JPG").touch()
    (photos / "e.heic").touch()
    call(photos)
    (told,) = [line for line in said if "since then" in line]
    assert "2 photographs are new and 1 photograph is gone and 1 photograph is changed;" in told and str(tmp_path / "out" / "run") in told
    (tmp_path / "moved" / "a.jpg").unlink()
    with pytest.raises(InputError, match=naming(tmp_path / "moved", photos)):
        call(tmp_path / "moved")
    with pytest.raises(InputError, match=r"found .* for both; choose another --out"):
        make(photos, photos, say=said.append)
    assert not (photos / making.SOURCE).exists()


def test_photographs_of_the_same_names_and_sizes_are_told_apart(tmp_path):
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "1.bmp").write_bytes(name.encode())
    one, two = (making.describe_source(tmp_path / name, tmp_path / "out")["files"] for name in ("one", "two"))
    assert making.tell_changes(one, two) == "1 photograph is changed" and making.tell_changes(one, dict(one)) == ""
    assert making.tell_changes({"1.bmp": 3}, one) == "", "notes of earlier versions have the sizes alone"


def test_a_call_that_can_use_nothing_leaves_no_folder_and_a_killed_one_goes_on(tmp_path, monkeypatch):
    left = []

    def reconstruct(source, out, options, few, say, progress):
        assert (out.parent / making.SOURCE).is_file()  # a kill after the capture is complete leaves the note too
        out.mkdir(exist_ok=True)
        for name in left:
            (out / name).touch()
        raise InputError("no poses")

    monkeypatch.setattr(making, "reconstruct", reconstruct)
    (tmp_path / "photos").mkdir()
    for kept in ([], ["colmap.log"]):
        left[:] = kept
        with pytest.raises(InputError, match="no poses"):
            make(tmp_path / "photos", tmp_path / "out", say=lambda _: None)
        assert (tmp_path / "out").exists() is bool(kept)
    with pytest.raises(InputError, match=naming(tmp_path / "none")):
        make(tmp_path / "none", tmp_path / "other", say=lambda _: None)
    assert not (tmp_path / "other").exists()


def test_what_counts_is_whether_photographs_are_held_out(tmp_path, capture, trained, monkeypatch):
    """Not the word of the split: with auto, few photographs are all trained on."""
    given = plan.load_capture
    monkeypatch.setattr(plan, "load_capture", lambda place, split, **more: given(place, split="none", **more))
    run = make(capture, tmp_path / "out", say=lambda _: None).run
    (run / "config.json").touch()
    begun = SimpleNamespace(data=SimpleNamespace(path=capture, split="auto", resolution="auto"), train=trained.made[0].recipe)
    monkeypatch.setattr(plan.run_folder, "read_config", lambda folder: begun)
    make(capture, tmp_path / "out", say=lambda _: None)
    assert trained.made[1].resume
    with pytest.raises(InputError, match="leave --scores out"):
        make(capture, tmp_path / "out", scores=True, say=lambda _: None)


def test_a_capture_has_its_poses(capture, tmp_path):
    with pytest.raises(InputError, match="--panoramas"):
        make(capture, tmp_path / "out", options=SourceOptions(panoramas="keep"))


def test_an_interrupted_training_is_saved_first(capture, tmp_path, trained, monkeypatch):
    class Interrupted(trained.Trainer):
        def __iter__(self):
            for event in super().__iter__():
                if event.step == 50:
                    signal.raise_signal(signal.SIGINT)
                yield event

    monkeypatch.setattr(making, "Trainer", Interrupted)
    with pytest.raises(KeyboardInterrupt):
        make(capture, tmp_path / "out", say=lambda _: None)
    assert trained.made[0].stopped and not (tmp_path / "out" / "scene.html").exists()


def test_photographs_that_are_not_there_leave_no_folder(tmp_path):
    with pytest.raises(InputError, match="none"):
        make(tmp_path / "none", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_no_time_is_no_budget(tmp_path):
    with pytest.raises(InputError, match="minutes"):
        make(tmp_path, minutes=0.0)


@pytest.mark.slow
def test_a_real_page_is_made_within_its_time(capture, tmp_path):
    made = make(capture, tmp_path / "out", minutes=0.5, say=lambda _: None)
    assert made.page.stat().st_size > 100_000 and made.psnr > 15
    again = make(capture, tmp_path / "out", minutes=0.5, say=lambda _: None)
    assert again.page == made.page and again.seconds["page"] < 1


def test_a_scene_is_named_after_its_source(tmp_path, capture):
    (tmp_path / "2024.05.12").mkdir()
    (tmp_path / "walk.mp4").touch()
    assert [name_source(tmp_path / name) for name in ("2024.05.12", "walk.mp4")] == ["2024.05.12", "walk"]
    (tmp_path / "attic").mkdir()
    (tmp_path / "attic" / "capture").symlink_to(capture)
    assert name_source(capture) == capture.name
