"""Records: written, found again, refused when changed by hand."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.core.io import write_json
from scene_experts.core.plain import to_json
from scene_experts.data import capture as captures
from scene_experts.reproduce import store
from scene_experts.reproduce.plan import OWN, CaptureSpec, Scale, Spec, drop_repeated
from scene_experts.reproduce.store import POINTS, SAMPLES, check_captures, digest, find, find_all, load, read, read_curves, read_run, write
from scene_experts.strategy.grow import GrowAnchors
from support.messages import naming
from support.records import record
from support.synthetic import make_capture


def test_a_record_comes_back_as_it_was_without_the_place_of_the_capture(tmp_path):
    made = record()
    made = replace(made, config=replace(made.config, data=replace(made.config.data, path=Path("/home/someone/fox")), command="secret"))
    path = write(tmp_path, made)
    assert "someone" not in path.read_text() and "secret" not in path.read_text()
    (back,) = read(path)
    assert (back.key, back.results, back.per_view) == (made.key, made.results, made.per_view)
    assert [point["psnr"] for point in back.curves] == [20.0] * 3 and back.fit == made.fit
    assert [r.key for r in load(tmp_path)] == [made.key]


def test_a_record_names_the_run_that_it_started_from_if_there_is_one(tmp_path):
    made = record()
    assert "init_from" not in json.loads(write(tmp_path, made).read_text())["runs"][0]["config"]
    begun = replace(made, config=replace(made.config, init_from=Path("/home/someone/coarse")))
    assert {record.config.init_from for record in read(write(tmp_path, begun))} == {None, Path("coarse")}


def test_a_run_that_started_from_another_one_is_not_taken_for_the_run_of_its_recipe(tmp_path):
    spec = Spec(CaptureSpec("fox", OWN, Path("fox")), "moe-gs", 0, Scale(iterations=3000))
    begun = replace(record(psnr=20.0), config=replace(record().config, init_from=Path("/home/someone/coarse")))
    (back,) = read(write(tmp_path, begun))
    assert back.key == begun.key and find(load(tmp_path), spec) is None
    write(tmp_path, record(psnr=30.0))
    found = find(load(tmp_path), spec)
    assert len(load(tmp_path)) == 2 and found is not None and found.results["psnr"] == 31.5


@pytest.mark.parametrize(
    ("place", "kept"),
    [
        ("cache /home/some one/.cache/scene-experts/lpips_vgg.safetensors", "cache lpips_vgg.safetensors"),
        ("/home/someone/vgg16.ckpt", "vgg16.ckpt"),
        ("C:\\Users\\someone\\vgg16.ckpt", "vgg16.ckpt"),
        ("vgg16.ckpt", "vgg16.ckpt"),
    ],
)
def test_a_record_does_not_say_where_the_weights_of_lpips_were(tmp_path, place, kept):
    made = record()
    path = write(tmp_path, replace(made, results={**made.results, "lpips_weights": {"vgg": place}}))
    assert read(path)[0].results == {**made.results, "lpips_weights": {"vgg": kept}} and "some" not in path.read_text()


def test_a_record_keeps_the_code_that_it_was_trained_with(tmp_path):
    made = replace(record(), code="0123456789ab")
    (back,) = read(write(tmp_path, made))
    assert (back.code, back.key) == (made.code, made.key) and made.key != record().key
    assert ["code" in run for run in json.loads(write(tmp_path, record()).read_text())["runs"]].count(True) == 1


def test_a_record_is_small_and_states_what_differs_from_the_defaults(tmp_path):
    many = {f"DSC_{i:04}.jpg": {"psnr": 30 + i / 7, "ssim": 0.9 + i / 1e4, "lpips": i / 300, "lpips_3dgs": i / 301} for i in range(32)}
    shares = {a: [i / 11 for i in range(5)] for a in ("opacity", "cov", "color")}
    curves = [{"step": 10 * i, "seconds": i / 3, "psnr": 20 + i / 7, "anchors": 150_000, "scene_routing": shares} for i in range(200)]
    psnr = sum(view["psnr"] for view in many.values()) / 32
    means = {name: sum(view[name] for view in many.values()) / 32 for name in ("ssim", "lpips", "lpips_3dgs")}
    made = record()
    made = replace(made, per_view=many, results={**made.results, **means, "psnr": psnr}, curves=store.thin(curves))
    path = write(tmp_path, made)
    assert len(path.read_bytes()) < 8000 and len(read(path)[0].curves) == POINTS
    assert json.loads(path.read_text())["runs"][0]["config"]["train"] == {
        "type": "Train",
        "recipe": "moe-gs",
        "scene": {"type": "Anchors", "decoder": {"type": "Experts"}},
        "loss": {"type": "Weights", "opacity": 0.01, "load": 0.01},
        "iterations": 3000,
    }


def test_a_record_of_a_part_that_changed_counts_as_no_run(tmp_path, monkeypatch):
    spec = Spec(CaptureSpec("fox", OWN, Path("fox")), "moe-gs", 0, Scale(iterations=3000))
    write(tmp_path, record())
    assert find(load(tmp_path), spec) is not None
    monkeypatch.setattr(GrowAnchors, "changes", ("Candidates are counted twice.",))
    assert load(tmp_path) == [] and find(load(tmp_path), spec) is None
    write(tmp_path, record())
    assert find(load(tmp_path), spec) is not None
    monkeypatch.setattr(GrowAnchors, "changes", ())
    assert len(load(tmp_path)) == 1


def test_a_record_takes_the_place_of_one_of_the_same_run(tmp_path):
    for psnr in (30.0, 31.0):
        write(tmp_path, record(psnr=psnr))
    write(tmp_path, record(seed=1))
    assert [(r.seed, r.results["psnr"]) for r in load(tmp_path)] == [(0, 32.5), (1, 31.5)]


def test_several_processes_write_one_file(tmp_path):
    code = "import sys; from pathlib import Path; from support.records import record; from scene_experts.reproduce.store import write; "
    code += "[write(Path(sys.argv[1]), record(seed=int(sys.argv[2]) + i)) for i in range(5)]"
    start = lambda seed: subprocess.Popen([sys.executable, "-c", code, str(tmp_path), str(seed)], cwd=Path(__file__).parents[2])  # noqa: E731
    assert [process.wait() for process in [start(0), start(10)]] == [0, 0]
    assert len(load(tmp_path)) == 10


def test_a_run_is_found_by_its_spec(tmp_path):
    spec = Spec(CaptureSpec("fox", OWN, Path("anywhere/fox")), "moe-gs", 0, Scale(iterations=3000))
    assert find([record(seed=1), record()], spec) is not None
    assert find([record(seed=1), record(iterations=7000)], spec) is None


def test_records_of_another_capture_of_the_same_name_are_refused(tmp_path):
    box = make_capture(tmp_path / "box", views=9)
    spec = Spec(CaptureSpec("box", OWN, box.folder), "moe-gs", 0, Scale(iterations=3000))
    capture = captures.load(spec.data)
    own = replace(record(scene="box"), per_view={capture.views[i].name: {"psnr": 30.0} for i in capture.test})
    check_captures([own], [spec])
    check_captures([record(scene="box", seed=1)], [spec])  # counts as no run that is asked for
    with pytest.raises(InputError, match=naming("0.png, 1.png, 2.png", "--records")):
        check_captures([record(scene="box")], [spec])
    check_captures([record(scene="box")], [replace(spec, scene=replace(spec.scene, path=tmp_path / "gone"))])


def test_records_of_other_poses_of_the_same_photographs_are_refused(tmp_path):
    box = make_capture(tmp_path / "box", views=9, points=700)
    specs = [Spec(CaptureSpec("box", OWN, box.folder), recipe, 0, Scale(iterations=3000)) for recipe in ("scaffold-gs", "moe-gs")]
    capture = captures.load(specs[0].data)
    views = {capture.views[i].name: {"psnr": 30.0} for i in capture.test}
    found = [replace(record(s.recipe, scene="box", psnr=30.0, views=1, points=n), per_view=views) for s, n in zip(specs, (651, 700))]
    check_captures([replace(r, results={**r.results, "points": len(capture.points.xyz)}) for r in found], specs)
    with pytest.raises(InputError, match=naming("651", "box", "--records")):
        check_captures([found[0], replace(found[1], results={**found[1].results, "points": len(capture.points.xyz)})], specs)


def test_records_of_other_cameras_with_the_same_points_are_refused(tmp_path):
    box, moved = make_capture(tmp_path / "box", views=9), make_capture(tmp_path / "other" / "box", views=9, scale=2.0)
    spec = Spec(CaptureSpec("box", OWN, box.folder), "moe-gs", 0, Scale(iterations=3000))
    capture, other = captures.load(spec.data), captures.load(replace(spec.data, path=moved.folder))
    own = replace(record(scene="box"), per_view={capture.views[i].name: {"psnr": 30.0} for i in capture.test})
    check_captures([replace(own, results={**own.results, "poses": capture.poses()})], [spec])
    with pytest.raises(InputError, match=naming("camera poses", "--records")):
        check_captures([replace(own, results={**own.results, "poses": other.poses()})], [spec])


def test_records_of_other_photographs_or_masks_are_refused(tmp_path):
    box = make_capture(tmp_path / "box", views=9)
    spec = Spec(CaptureSpec("box", OWN, box.folder), "moe-gs", 0, Scale(iterations=3000))
    capture = captures.load(spec.data)
    own = replace(record(scene="box"), per_view={capture.views[i].name: {"psnr": 30.0} for i in capture.test})
    check_captures([own], [spec])  # an older record does not say
    own = replace(own, results={**own.results, "photographs": capture.photographs()})
    check_captures([own], [spec])
    path = capture.views[0].path
    before = path.read_bytes()
    path.write_bytes(before + b"\0")
    with pytest.raises(InputError, match=naming("photographs and masks", "--records")):
        check_captures([own], [spec])
    path.write_bytes(before)
    check_captures([own], [spec])
    (box.folder / "masks").mkdir(exist_ok=True)
    for view in capture.views:
        Image.new("L", (view.camera.width, view.camera.height), 255).save(box.folder / "masks" / f"{view.name}.png")
    with pytest.raises(InputError, match=naming("photographs and masks", "--records")):
        check_captures([own], [spec])


def test_records_of_a_newer_version_are_not_called_something_else(tmp_path):
    (tmp_path / "fox.json").write_text('{"format": 99, "scene": "fox", "runs": []}')
    with pytest.raises(InputError, match=naming("format 99", "update")):
        load(tmp_path)


def test_a_run_that_memory_may_have_limited_is_no_record(tmp_path):
    made = record()
    write_json(tmp_path / "config.json", {"format": 1, **to_json(replace(made.config, max_memory=2.0))})
    write_json(tmp_path / "results.json", made.results)
    write_json(tmp_path / "per_view.json", made.per_view)
    with pytest.raises(InputError, match=naming("--max-memory 2")):
        read_run(tmp_path, "fox")


def test_changed_figures_are_refused(tmp_path):
    path = write(tmp_path, record())
    value = json.loads(path.read_text())
    value["runs"][0]["results"]["psnr"] = 99.0
    path.write_text(json.dumps(value))
    with pytest.raises(InputError, match=naming(tmp_path)):
        read(path)
    path = write(tmp_path, record())
    value = json.loads(path.read_text())
    del value["runs"][0]["per_view"]["scores"]["psnr"][1:]
    resealed(value)
    path.write_text(json.dumps(value))
    with pytest.raises(InputError, match=naming(tmp_path)):
        read(path)
    path = write(tmp_path, record())
    value = json.loads(path.read_text())
    value["runs"][0]["per_view"]["scores"]["psnr"][0] += 1.0
    resealed(value)
    path.write_text(json.dumps(value))
    with pytest.raises(InputError, match=naming(tmp_path, "psnr")):
        read(path)
    for other in ("{}", '{"format": 1}'):
        path.write_text(other)
        with pytest.raises(InputError, match=naming(tmp_path)):
            read(path)


def resealed(value):
    """Give an edited record its checksum."""
    (run,) = value["runs"]
    run["sha256"] = store.digest({name: each for name, each in run.items() if name != "sha256"})


def test_scores_by_view_of_another_evaluation_are_refused(tmp_path):
    made = record()
    write_json(tmp_path / "config.json", {"format": 1, **to_json(made.config)})
    write_json(tmp_path / "results.json", made.results)
    write_json(tmp_path / "per_view.json", made.per_view)
    assert read_run(tmp_path, "fox").per_view == made.per_view
    write_json(tmp_path / "per_view.json", record(psnr=29.0).per_view)  # the next evaluation was killed between its two files
    with pytest.raises(InputError, match=naming("scene-experts eval")):
        read_run(tmp_path, "fox")


def test_a_folder_without_results_is_refused(tmp_path):
    with pytest.raises(InputError, match=naming("config.json")):
        read_run(tmp_path, "fox")


def test_a_training_scored_before_its_end_is_no_record(tmp_path):
    made = record(iterations=3000)
    write_json(tmp_path / "config.json", {"format": 1, **to_json(made.config)})
    write_json(tmp_path / "per_view.json", made.per_view)
    write_json(tmp_path / "results.json", {**made.results, "step": 1200})
    with pytest.raises(InputError, match=naming("3,000", "1,200")):
        read_run(tmp_path, "fox")
    write_json(tmp_path / "results.json", {**made.results, "step": 3000})
    assert read_run(tmp_path, "fox").key == made.key


def test_curves_keep_the_ends_and_skip_torn_lines(tmp_path):
    path = tmp_path / "metrics.jsonl"
    lines = [json.dumps({"step": s, "psnr": 1.0, "terms": {}}) for s in range(1, 1001)] + [
        '{"grown": 1, "step": 5}',
        '{"psnr": NaN, "step": 7}',
        '{"step": 99',
    ]
    path.write_bytes("\n".join(lines).encode() + b"\n\xff\xfe")
    found = read_curves(path)
    assert len(found) == SAMPLES and (found[0]["step"], found[-1]["step"]) == (1, 1000) and "terms" not in found[0]
    thinned = store.thin(found)
    assert len(thinned) == POINTS and (thinned[0]["step"], thinned[-1]["step"]) == (1, 1000)
    late = [line for line in found if line["step"] > 500]
    assert store.fit_of([{**line, "psnr": float(line["step"])} for line in found], 1000) == sum(line["step"] for line in late) / len(late)
    assert read_curves(tmp_path / "none") == []


def test_columns():
    made = record(mb=12.0, active=0.5)
    assert [made.value(c) for c in ("size_mb", "active_percent", "psnr", "unknown")] == [12.0, 50.0, 31.5, None]
    assert replace(made, results={**made.results, "activation_ratio": None}).value("active_percent") is None


def test_a_run_counts_for_every_recipe_of_the_same_numbers(tmp_path):
    """Five experts with Top-2 in Figure 6 are the main recipe, two layers in Figure 7 are Scaffold-GS."""
    scene = CaptureSpec("fox", OWN, tmp_path)
    pair = [Spec(scene, recipe, 0, Scale(iterations=3000)) for recipe in ("moe-gs", "moe-gs-e5-top2")]
    assert drop_repeated([*pair, Spec(scene, "moe-gs-e4-top2", 0, Scale(iterations=3000))]) == [
        pair[0],
        Spec(scene, "moe-gs-e4-top2", 0, Scale(iterations=3000)),
    ]
    write(tmp_path, record("moe-gs", "fox"))
    found = find_all(load(tmp_path), pair)
    assert [r.recipe for r in found] == ["moe-gs", "moe-gs-e5-top2"] and [r.key for r in found] == [s.key for s in pair]
    assert find(load(tmp_path), Spec(scene, "moe-gs-e5-top1", 0, Scale(iterations=3000))) is None


def test_a_file_keeps_the_lines_of_its_other_runs(tmp_path):
    first = write(tmp_path, record(seed=1)).read_text().splitlines()[1]
    lines = write(tmp_path, record(seed=2)).read_text().splitlines()[1:]
    assert lines[0] == first + "," and all(json.loads(line.rstrip(","))["seed"] for line in lines[:2])


@pytest.mark.parametrize("name", ["key", "recipe", "seed", "sha256"])
def test_a_run_without_a_part_is_named_also_before_another_is_added(tmp_path, name):
    path = write(tmp_path, record())
    whole = json.loads(path.read_text())
    del whole["runs"][0][name]
    write_json(path, whole)
    for act in (lambda: read(path), lambda: write(tmp_path, record(seed=1))):
        with pytest.raises(InputError, match=f"found a run without {name}; remove it"):
            act()


def test_the_record_of_a_part_that_is_not_installed_leaves_the_others(tmp_path, caplog):
    path = write(tmp_path, record(seed=1))
    write(tmp_path, record(seed=2))
    whole = json.loads(path.read_text())
    run = whole["runs"][0]
    run["config"]["train"]["scene"] = {"type": "TheirScene"}
    run["sha256"] = digest({part: value for part, value in run.items() if part != "sha256"})
    write_json(path, whole)
    assert [each.seed for each in read(path)] == [2]
    assert "left out 1 of the records" in caplog.text and "TheirScene" in caplog.text


def test_a_whole_number_is_the_number_that_a_record_gives_back(tmp_path):
    made = record()
    whole = replace(made, config=replace(made.config, train=replace(made.config.train, loss=replace(made.config.train.loss, opacity=2))))
    (back,) = read(write(tmp_path, whole))
    assert back.key == whole.key and isinstance(back.config.train.loss.opacity, float)


def test_curves_leave_out_the_shares_of_many_experts():
    for experts, kept in ((store.MOST_EXPERTS, True), (store.MOST_EXPERTS + 1, False)):
        line = {"step": 10, "psnr": 20.0, "scene_routing": {"color": [1 / experts] * experts}}
        assert bool(store.thin([line, line])[0]["scene_routing"]) is kept
