"""The one entry for files: several formats, and what is refused."""

import json
from dataclasses import replace

import pytest

from scene_experts.core.errors import InputError
from scene_experts.files.export import _check, export, export_several
from scene_experts.files.options import DEFAULT, Options
from scene_experts.training import run_folder
from support.exports import SHORT
from support.files import export_run
from support.messages import naming
from support.synthetic import make_capture


@pytest.mark.parametrize("short", ["moe-gs"], indirect=True)
def test_several_formats_share_one_bake(short, tmp_path):
    said = []
    opened, options = run_folder.open_run(short), Options(measure=False, sh_degree=1, refine=0, floaters="remove", crop="sphere:3x")
    tell = lambda what, done, total: said.append(what) if done == total else None  # noqa: E731
    written = export_several(opened, ("ply", "spz", "compact"), tmp_path / "all", replace(options, floaters="keep", crop=None), tell=tell)
    assert len(written) == 3
    assert said.count("summing contributions") == 1 and "same bake" in " ".join(line for w in written for line in w.lines)
    (one,) = export(opened, "ply", tmp_path / "one.ply", replace(options, floaters="keep", crop=None))
    assert one.path.read_bytes() == (tmp_path / "all" / "scene.ply").read_bytes()
    chosen = export_several(opened, ("ply", "spz"), tmp_path / "some", options, tell=tell)
    assert said.count("finding floaters") == 1 and "sphere:3x" in " ".join(chosen[1].lines) and chosen[0].rows <= one.rows
    about = json.loads((tmp_path / "some" / "scene.spz.json").read_text())
    assert about["crop"] == "sphere:3x" and about["floaters"] >= 0
    with pytest.raises(InputError, match="--out"):
        export_several(opened, ("ply", "spz"), tmp_path / "a.ply", options)


@pytest.mark.parametrize("short", ["moe-gs"], indirect=True)
def test_what_cannot_be_is_refused_in_one_sentence(short, tmp_path):
    with pytest.raises(InputError, match=naming("obj", "ply")):
        export_run(short, "obj")
    file = tmp_path / "x.ply"
    wrong = {"levels": True, "sh_degree": 5, "max_gaussians": -1, "refine": -1, "prune": 1.0}
    for name, value in wrong.items():
        with pytest.raises(InputError, match="--" + name.replace("_", "-")):
            export_run(short, "ply", file, **{name: value})
    with pytest.raises(InputError, match=naming("gone", "--data")):
        export_run(short, "ply", file, data=tmp_path / "gone", **SHORT)
    other = make_capture(tmp_path / "other", views=10, size=(48, 32), points=50).folder
    with pytest.raises(InputError, match="--data"):
        export_run(short, "ply", file, data=other, **SHORT)
    assert not file.exists()


@pytest.mark.parametrize("short", ["moe-gs"], indirect=True)
def test_a_capture_that_moved_is_found_by_its_flag(short, tmp_path):
    data = run_folder.read_config(short).data.path
    (tmp_path / "moved").symlink_to(data)
    (written,) = export_run(short, "ply", tmp_path / "x.ply", data=tmp_path / "moved", measure=True, **SHORT)
    assert "held-out views" in written.lines[2]


@pytest.mark.parametrize("name", ["sh_degree", "max_gaussians", "refine"])
def test_numbers_out_of_range_are_named_by_their_flag(name):
    with pytest.raises(InputError, match=naming("--" + name.replace("_", "-"), -1)):
        _check(Options(**{name: -1}))
    _check(DEFAULT)
    with pytest.raises(InputError, match=naming("--sh-degree", 4)):
        _check(Options(sh_degree=4))
    for prune in (1.0, -0.1, float("nan")):
        with pytest.raises(InputError, match="--prune"):
            _check(Options(prune=prune))
