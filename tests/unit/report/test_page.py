"""The report of one run and of several is complete and self-contained."""

import base64
import io
import json
import re

import pytest
from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.core.io import write_json
from scene_experts.report.page import NAME, write
from support.evaluated import make_run
from support.messages import naming


def test_one_run_is_one_file_that_needs_nothing_else(tmp_path):
    path = write([make_run(tmp_path)])
    text = path.read_text()
    assert path == tmp_path / NAME
    assert not re.findall(r'(?:src|href)="(?!data:)|https?://|@import', text)
    for word in ("moe-gs", "fox", "30.00", "--data &lt;here&gt;", "top_k"):
        assert word in text, word
    assert "$title" not in text and "$body" not in text
    pictures = json.loads(re.search(r"const pictures = (.+);</script>", text)[1])  # type: ignore[index]
    assert len(pictures) == 3 * 3
    first = Image.open(io.BytesIO(base64.b64decode(pictures["0.0.0"].partition(",")[2])))
    assert first.size == (960, 480) and first.getpixel((5, 5))[0] > 200  # type: ignore[index]


def strips(text):
    """The sizes of the strips of a page, by their attribute."""
    found = re.findall(r"<img class='strip' alt='(\w+) experts' src='data:image/jpeg;base64,([^']+)'>", text)
    return {attribute: Image.open(io.BytesIO(base64.b64decode(data))).size for attribute, data in found}


def test_strips_of_each_experts_anchors(tmp_path):
    folder = make_run(tmp_path)
    assert not strips(write([folder]).read_text())
    results = json.loads((folder / "results.json").read_text())
    shares = {"share": [0.5, 0.3, 0.2], "k": 2}
    write_json(folder / "results.json", {**results, "experts": dict.fromkeys(("opacity", "cov", "color"), shares)})
    (folder / "test" / "experts").mkdir()
    for attribute in ("opacity", "cov", "color"):
        Image.new("RGB", (2900, 400), "red").save(folder / "test" / "experts" / f"{attribute}.png")
    text = write([folder]).read_text()
    assert strips(text) == dict.fromkeys(("color", "opacity", "cov"), (1600, 221)) and list(strips(text)) == ["color", "opacity", "cov"]
    assert "Top-2" in text
    open_part = re.sub(r"<details>.*?</details>", "", text)
    assert list(strips(open_part)) == ["color"]
    (folder / "test" / "experts" / "color.png").unlink()
    write_json(folder / "results.json", {**results, "experts": {"cov": {"mean_gate": [0.5, 0.3, 0.2], "k": None}}})
    dense = write([folder]).read_text()
    assert list(strips(dense)) == ["cov"] and "Top-" not in dense.partition("<h2>Command")[0]


def test_several_runs_stand_beside_each_other(tmp_path):
    runs = [make_run(tmp_path / "a"), make_run(tmp_path / "b", "scaffold-gs")]
    text = write(runs, tmp_path / "both.html").read_text()
    assert text.count("<option value='0.0.1'") == 2
    same = write([tmp_path / "a", make_run(tmp_path / "c")], tmp_path / "same.html").read_text()
    assert "a (moe-gs)" in same and "c (moe-gs)" in same
    with pytest.raises(InputError, match="--out"):
        write(runs)
    with pytest.raises(InputError, match=naming("config.json")):
        write(runs, runs[0] / "config.json")
    assert write(runs, tmp_path) == tmp_path / "report.html"
    per_view = json.loads((runs[1] / "per_view.json").read_text())
    write_json(runs[1] / "per_view.json", {**per_view, "one more.png": next(iter(per_view.values()))})
    assert "<td>one more.png</td>" in write(runs, tmp_path).read_text()


@pytest.mark.slow
def test_runs_that_were_not_scored_alike_are_no_rivals(tmp_path):
    runs = [make_run(tmp_path / "a"), make_run(tmp_path / "b", "scaffold-gs")]
    alike = write(runs, tmp_path / "alike.html").read_text()
    assert "class=best" in alike and "Do not compare" not in alike
    results = json.loads((runs[1] / "results.json").read_text())
    write_json(runs[1] / "results.json", {**results, "capture": "kitchen"})
    text = write(runs, tmp_path / "other.html").read_text()
    assert "class=best" not in text
    assert "<b>Do not compare" in text
    write_json(runs[1] / "results.json", {**results, "capture": "kitchen", "split": "files", "step": 231, "iterations": 3000})
    write_json(runs[1] / "checkpoints" / "ckpt_000400.safetensors", {})
    text = write(runs, tmp_path / "other.html").read_text()
    assert "231 of 3,000" in text
    assert "400" in text and "scene-experts eval" in text
    assert "<h3>fox</h3>" in text and "<h3>kitchen</h3>" in text and "<h3>" not in alike
    pictures = json.loads(re.search(r"const pictures = (.+);</script>", text)[1])  # type: ignore[index]
    assert len(pictures) == 2 * 3 * 3  # of each its own photographs, renders and errors
    per_view = json.loads((runs[1] / "per_view.json").read_text())
    write_json(runs[1] / "per_view.json", {f"other-{name}": facts for name, facts in per_view.items()})
    write_json(runs[1] / "results.json", results)
    assert "const pictures = {}" in write(runs, tmp_path / "apart.html").read_text()


def test_a_run_without_pictures_or_results(tmp_path):
    assert "no pictures" in write([make_run(tmp_path / "a", pictures=False)]).read_text()
    (tmp_path / "a" / "results.json").unlink()
    with pytest.raises(InputError, match=naming("results.json")):
        write([tmp_path / "a"])
    with pytest.raises(InputError):
        write([])


def test_torn_and_foreign_files(tmp_path):
    folder = make_run(tmp_path)
    with (folder / "metrics.jsonl").open("ab") as stream:
        stream.write(b"\xff\xfe\0\n")  # what a power cut leaves
    assert "gate entropy" in write([folder]).read_text()
    (folder / "test" / "gt" / "0.png").write_bytes(b"torn")
    with pytest.raises(InputError, match=naming("0.png")):
        write([folder])
    for wrong in ([1], {"a.png": 3}, {"a.png": {}}):
        write_json(folder / "per_view.json", wrong)
        with pytest.raises(InputError, match=naming("per_view.json")):
            write([folder])


def test_an_imported_run_claims_no_training(tmp_path):
    folder = make_run(tmp_path)
    results = json.loads((folder / "results.json").read_text())
    write_json(folder / "results.json", {**results, "step": 0, "iterations": 0, "train_seconds": 0.0})
    text = write([folder]).read_text()
    assert "0 iterations" not in text and "train s" not in text and "steps" not in text


def test_scores_are_explained_and_views_that_fail_are_named(tmp_path):
    folder = make_run(tmp_path)
    text = write([folder]).read_text()
    assert "what it is" in text and "likeness of pixels" in text and "class='warn'" not in text
    per_view = json.loads((folder / "per_view.json").read_text())
    name = list(per_view)[1]
    write_json(folder / "per_view.json", {**per_view, name: {**per_view[name], "psnr": 8.0}})
    text = write([folder]).read_text()
    assert "class='warn'" in text and f"{name} (8.0 dB)" in text and "<tr class=fails>" in text
    many = write([make_run(tmp_path / str(i)) for i in range(4)], tmp_path / "many.html").read_text()
    assert "<dl class=terms>" in many and "<main>" in many


def test_no_text_of_a_run_becomes_code_of_the_page(tmp_path):
    folder, code = make_run(tmp_path), "<script>alert(1)</script>"
    results = json.loads((folder / "results.json").read_text())
    shares = {"share": [0.5, 0.5], "k": code}
    said = dict.fromkeys(("capture", "views", "view_count", "split", "resolution", "recipe"), code)
    write_json(folder / "results.json", {**results, **said, "absent": {code: code}, "experts": {"color": shares}})
    views = json.loads((folder / "per_view.json").read_text())
    write_json(folder / "per_view.json", {f"{name}{code}": facts for name, facts in views.items()})
    (folder / "test" / "experts").mkdir()
    Image.new("RGB", (64, 16)).save(folder / "test" / "experts" / "color.png")
    assert code not in write([folder]).read_text()
