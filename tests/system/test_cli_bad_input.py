"""Unusable input of every kind through the command line: one sentence, exit code 2, and every file stays as it was.

The sentences are recorded in golden/errors.json (`make record-errors`), so that a review sees every change of them.
"""

from __future__ import annotations

import json
import re
import shutil
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from scene_experts import cli
from scene_experts.core import checkpoint
from scene_experts.data.readers.colmap_model import Model, read_model, write_model
from support.golden import recorded
from support.synthetic import make_blender, make_capture

ITERATIONS = ("--iterations", "4", "--preview-every", "0")


def iterations(more: list[str]) -> tuple[str, ...]:
    """Options of a short training, without those that `more` gives."""
    return ITERATIONS[2:] if "--iterations" in more else ITERATIONS


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    return make_capture(tmp_path_factory.mktemp("made"), views=9, size=(48, 32), points=300).folder


@pytest.fixture
def capture(made, tmp_path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "capture"))


@pytest.fixture(scope="module")
def trained(made, tmp_path_factory) -> Path:
    """A run with one checkpoint, and beside it one without held-out views."""
    root = tmp_path_factory.mktemp("trained")
    for name, more in (("run", ()), ("none", ("--split", "none"))):
        assert cli.main(["train", "moe-gs", "--data", str(made), "--out", str(root / name), *ITERATIONS, *more]) == 0
    return root


def said(capsys, *args: object) -> tuple[int, str]:
    """The exit code of a command and the sentence of its error; an empty one where there is none."""
    capsys.readouterr()
    try:
        code = cli.main([str(a) for a in args])
    except SystemExit as stop:
        code = stop.code
    err = capsys.readouterr().err
    assert "Traceback" not in err
    found = [line.removeprefix("error: ") for line in err.splitlines() if line.startswith("error: ")]
    assert len(found) <= 1, err
    return code, found[0] if found else ""


def as_recorded(case: str, sentence: str, tmp: Path, *others: Path) -> None:
    """Compare a sentence with the recorded one, without the folders of this machine and the words of other libraries."""
    assert sentence
    for folder in (*others, tmp):
        sentence = sentence.replace(str(folder), "TMP")
    sentence = re.sub(r"\bmade\d+\b", "CAPTURE", sentence)
    foreign = "cannot identify|image file is|Error while|Expecting|checksum"
    sentence = re.sub(rf"\((?={foreign}).*?\)(?=[;, ])", "(...)", sentence)
    sentence = re.sub(rf"(?<=: )(?={foreign}).*?(?=;)", "...", sentence)
    assert recorded("errors.json", case, lambda: sentence) == sentence


# --- captures -----------------------------------------------------------------------------------------------------------------------------


def cut(name: str, share: float = 0.5) -> Callable[[Path], None]:
    def act(capture: Path) -> None:
        data = (capture / name).read_bytes()
        (capture / name).write_bytes(data[: int(len(data) * share)])

    return act


def gone(name: str) -> Callable[[Path], None]:
    return lambda capture: shutil.rmtree(capture / name) if (capture / name).is_dir() else (capture / name).unlink()


def holds(name: str, data: bytes) -> Callable[[Path], object]:
    return lambda capture: (capture / name).write_bytes(data)


def model(change: Callable[[Model], Model], text: bool = False) -> Callable[[Path], None]:
    def act(capture: Path) -> None:
        found = read_model(capture / "sparse/0")
        shutil.rmtree(capture / "sparse/0")
        write_model(capture / "sparse/0", change(found), text=text)

    return act


def first_image(**changes: object) -> Callable[[Path], None]:
    return model(lambda m: replace(m, images=(replace(m.images[0], **changes), *m.images[1:])))  # type: ignore[arg-type]


def camera_model(capture: Path) -> None:
    data = bytearray((capture / "sparse/0/cameras.bin").read_bytes())
    data[12:16] = struct.pack("<i", 77)
    (capture / "sparse/0/cameras.bin").write_bytes(data)


def camera_model_text(capture: Path) -> None:
    model(lambda m: m, text=True)(capture)
    path = capture / "sparse/0/cameras.txt"
    path.write_text(path.read_text().replace("PINHOLE", "WIDE"))


EMPTY = struct.pack("<Q", 0)
CAPTURES: dict[str, Callable[[Path], object]] = {
    **{f"{part} missing": gone(f"sparse/0/{part}.bin") for part in ("cameras", "images", "points3D")},
    **{f"{part} truncated": cut(f"sparse/0/{part}.bin") for part in ("cameras", "images", "points3D")},
    **{f"{part} is not one": holds(f"sparse/0/{part}.bin", bytes(range(256)) * 8) for part in ("cameras", "images", "points3D")},
    "no reconstruction": gone("sparse"),
    "no cameras": holds("sparse/0/cameras.bin", EMPTY),
    "no registered images": holds("sparse/0/images.bin", EMPTY),
    "no 3D points": holds("sparse/0/points3D.bin", EMPTY),
    "NaN pose": first_image(translation=(float("nan"), 0.0, 0.0)),
    "zero quaternion": first_image(quaternion=(0.0, 0.0, 0.0, 0.0)),
    "unknown camera": first_image(camera_id=55),
    "unknown camera model": camera_model,
    "unknown camera model in text": camera_model_text,
    "image folder absent": gone("images"),
    "image absent": gone("images/view_003.png"),
    "image not a picture": holds("images/view_003.png", b"no picture"),
    "image empty": holds("images/view_003.png", b""),
    "image cut short": cut("images/view_003.png"),
}


@pytest.mark.parametrize("case", list(CAPTURES))
def test_captures(case, capture, tmp_path, capsys):
    CAPTURES[case](capture)
    code, sentence = said(capsys, "train", "moe-gs", "--data", capture, "--out", tmp_path / "out", *ITERATIONS)
    assert code == 2 and not (tmp_path / "out").exists()
    as_recorded(case, sentence, tmp_path)


def test_a_photograph_that_breaks_while_training(capture, tmp_path, capsys):
    """A photograph with a valid header and damaged pixels fails when its view is used. Saved checkpoints remain."""
    from PIL import Image

    for i in range(9):
        picture = capture / "images" / f"view_{i:03d}"
        Image.open(picture.with_suffix(".png")).save(picture.with_suffix(".jpg"))
        picture.with_suffix(".png").unlink()
    cut("images/view_003.jpg", 0.7)(capture)
    out = tmp_path / "out"
    arguments = ("train", "moe-gs", "--data", capture, "--out", out, "--iterations", "20", "--save-every", "1", "--preview-every", "0")
    code, sentence = said(capsys, *arguments)
    assert code == 2 and "view_003.jpg" in sentence
    as_recorded("photograph cut short", sentence, tmp_path)
    newest = checkpoint.latest(out / "checkpoints")  # None where the broken one came first
    assert not list(out.rglob("*.part")) and (newest is None or checkpoint.load(newest)[1]["step"] >= 1)


@pytest.mark.parametrize("change", [holds("sparse/0/points3D.bin", EMPTY), gone("sparse/0/points3D.bin")])
def test_without_points_it_trains_from_random_ones(change, capture, tmp_path, capsys):
    change(capture)
    assert said(capsys, "train", "moe-gs", "--data", capture, "--out", tmp_path / "out", *ITERATIONS, "--init", "random") == (0, "")
    assert said(capsys, "eval", tmp_path / "out", "--no-lpips") == (0, "")


def test_dropping_absent_images_trains_without_them(capture, tmp_path, capsys):
    gone("images/view_003.png")(capture)
    assert said(capsys, "train", "moe-gs", "--data", capture, "--out", tmp_path / "out", *ITERATIONS, "--missing", "drop") == (0, "")


@pytest.mark.parametrize(("case", "text"), [("transforms cut short", '{"frames": ['), ("transforms without frames", '{"frames": []}')])
def test_transforms(case, text, tmp_path, capsys):
    make_blender(tmp_path / "c", views=3, size=16)
    (tmp_path / "c" / "transforms_train.json").write_text(text)
    code, sentence = said(capsys, "info", tmp_path / "c")
    assert code == 2
    as_recorded(case, sentence, tmp_path)


def test_paths_without_a_capture(made, tmp_path, capsys):
    (tmp_path / "file").write_text("x")
    (tmp_path / "empty").mkdir()
    for case, path in (("capture is a file", "file"), ("capture is absent", "absent"), ("capture is empty", "empty")):
        for command in (["info", tmp_path / path], ["train", "moe-gs", "--out", tmp_path / "r", "--data", tmp_path / path]):
            code, sentence = said(capsys, *command)
            assert code == 2 and not (tmp_path / "r").exists()
            scene = path == "file" and command[0] == "info"  # which also tells what the file of a scene holds
            as_recorded("scene of no known format" if scene else case, sentence, tmp_path)


# --- flags --------------------------------------------------------------------------------------------------------------------------------

FLAGS = {
    "resolution unknown": ["--resolution", "half"],
    "resolution zero": ["--resolution", "factor:0"],
    "resolution without its folder": ["--resolution", "inria:8"],
    "split unknown": ["--split", "odd"],
    "split leaves nothing": ["--split", "first:9"],
    "split not in the files": ["--split", "files"],
    "image folder unknown": ["--images", "images_9"],
    "no views": ["--max-views", "0"],
    "background out of range": ["--background", "2", "0", "0"],
    "not a number": ["--loss.load", "nan"],
    "iterations zero": ["--iterations", "0"],
    "stop before the start": ["--stop-at", "0"],
    "more chosen than there are": ["--scene.decoder.top-k", "9"],
    "unknown attribute": ["--scene.add-dist", "depth"],
    "start unknown": ["--init", "sparse"],
    "rate below zero": ["--rate", "-1"],
    "resume without a run": ["--resume"],
    "resume and overwrite": ["--resume", "--overwrite"],
}


@pytest.mark.parametrize("case", list(FLAGS))
def test_flags(case, made, tmp_path, capsys):
    code, sentence = said(capsys, "train", "moe-gs", "--data", made, "--out", tmp_path / "out", *iterations(FLAGS[case]), *FLAGS[case])
    assert code == 2 and not (tmp_path / "out").exists()
    as_recorded(case, sentence, tmp_path, made)


STARTS = {
    "dense start of two photographs": (lambda capture: None, ["--max-views", "2"]),
    "dense start without points": (gone("sparse/0/points3D.bin"), []),
    "dense start of points behind the cameras": (model(lambda m: replace(m, xyz=m.xyz * 0 + (0.0, 0.0, 40.0))), []),
}


@pytest.mark.parametrize("case", list(STARTS))
def test_dense_starts(case, capture, tmp_path, capsys):
    change, more = STARTS[case]
    change(capture)
    code, sentence = said(capsys, "train", "moe-gs", "--data", capture, "--out", tmp_path / "out", *ITERATIONS, "--init", "dense", *more)
    assert code == 2 and not list((tmp_path / "out").glob("checkpoints/*"))
    as_recorded(case, sentence, tmp_path)


@pytest.mark.parametrize("more", [[], ["--overwrite"], ["--resume"]])
def test_out_that_is_a_file_is_left_alone(more, made, tmp_path, capsys):
    (tmp_path / "file").write_text("precious")
    for place in (tmp_path / "file", tmp_path / "file" / "below"):
        code, sentence = said(capsys, "train", "moe-gs", "--data", made, "--out", place, *ITERATIONS, *more)
        assert code == 2
        as_recorded(f"out is {'a file' if place.name == 'file' else 'below a file'}", sentence, tmp_path)
    assert (tmp_path / "file").read_text() == "precious"


# --- runs ---------------------------------------------------------------------------------------------------------------------------------


def state(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


RUNS = {
    "over another run": ("moe-gs", []),
    "resume another recipe": ("scaffold-gs", ["--resume"]),
    "resume with other numbers": ("moe-gs", ["--resume", "--loss.load", "0.5"]),
    "resume with another length": ("moe-gs", ["--resume", "--iterations", "8"]),
    "resume with another split": ("moe-gs", ["--resume", "--split", "none"]),
    "overwrite with what cannot be": ("moe-gs", ["--overwrite", "--scene.voxel-size", "1e-9"]),  # found out when the scene begins
}


@pytest.mark.parametrize("case", list(RUNS))
def test_what_a_run_folder_refuses_leaves_it_as_it_was(case, made, trained, tmp_path, capsys):
    recipe, more = RUNS[case]
    before = state(trained / "run")
    code, sentence = said(capsys, "train", recipe, "--data", made, "--out", trained / "run", *iterations(more), *more)
    assert code == 2 and state(trained / "run") == before
    as_recorded(case, sentence, trained)


def test_no_held_out_views(trained, capsys, caplog):
    """The training views are scored, and that is told."""
    assert cli.main(["eval", str(trained / "none"), "--no-lpips"]) == 0
    assert "no view is held out" in caplog.text and (trained / "none/results_train.json").is_file()
    assert said(capsys, "eval", trained / "none", "--no-lpips", "--views", "train") == (0, "")


def test_truncated_checkpoints(made, trained, tmp_path, capsys):
    """The newest is cut: the one before it is taken. Both are: it is said, and nothing is overwritten."""
    run = Path(shutil.copytree(trained / "run", tmp_path / "run"))
    resume = ("train", "moe-gs", "--data", made, "--out", run, "--iterations", "8", "--preview-every", "0", "--save-every", "4")
    (run / "config.json").write_text((run / "config.json").read_text().replace('"iterations": 4', '"iterations": 8'))
    shutil.rmtree(run / "checkpoints")
    assert said(capsys, *resume, "--resume") == (0, "")  # no checkpoint yet: from the start
    four, eight = (run / "checkpoints" / f"ckpt_00000{n}.safetensors" for n in (4, 8))
    whole = eight.read_bytes()
    eight.write_bytes(whole[: len(whole) // 2])
    assert said(capsys, "eval", run, "--no-lpips") == (0, "") and json.loads((run / "results.json").read_text())["step"] == 4
    code, sentence = said(capsys, "eval", run, "--no-lpips", "--step", "8")
    assert code == 2
    as_recorded("checkpoint truncated", sentence, tmp_path)
    assert said(capsys, *resume, "--resume") == (0, "") and checkpoint.load(eight)[1]["step"] == 8
    for path in (four, eight):
        path.write_bytes(b"")
    before = state(run)
    for case, arguments in (("checkpoints truncated, eval", ("eval", run)), ("checkpoints truncated, resume", (*resume, "--resume"))):
        code, sentence = said(capsys, *arguments)
        assert code == 2 and state(run) == before
        as_recorded(case, sentence, tmp_path)


OTHERS = {
    "eval of a file": ["eval", "TMP/file"],
    "eval of nothing": ["eval", "TMP/absent"],
    "export of a file": ["export", "TMP/file"],
    "compare of a file": ["compare", "TMP/file"],
    "import of nothing": ["import", "TMP/absent", "--data", "MADE", "--out", "TMP/r"],
    "import of a text": ["import", "TMP/file", "--data", "MADE", "--out", "TMP/r"],
    "import to a file": ["import", "RUN", "--data", "MADE", "--out", "TMP/file"],
    "eval of another step": ["eval", "RUN", "--step", "3"],
    "eval of an empty name": ["eval", ""],
    "export to an empty name": ["export", "RUN", "--out", ""],
    "export to an empty name, joined": ["export", "RUN", "--out="],
    "eval with weights from nowhere": ["eval", "RUN", "--lpips-weights", "TMP/absent"],
    "eval with a capture from nowhere": ["eval", "RUN", "--data", "TMP/absent"],
    "rate of Gaussians": ["train", "3dgs", "--data", "MADE", "--out", "TMP/r", "--rate", "0.1"],
}


@pytest.mark.parametrize("case", list(OTHERS))
def test_other_commands(case, made, trained, tmp_path, capsys):
    (tmp_path / "file").write_text("precious")
    where = {"TMP": tmp_path, "MADE": made, "RUN": trained / "run"}
    code, sentence = said(capsys, *(re.sub("^(TMP|MADE|RUN)", lambda m: str(where[m[0]]), word) for word in OTHERS[case]))
    assert code == 2 and (tmp_path / "file").read_text() == "precious" and not (tmp_path / "r").exists()
    as_recorded(case, sentence, tmp_path, trained, made)


TRAIN = ["train", "moe-gs", "--data", "c", "--out", "r"]
WORDS = {
    "no recipe": ["train"],
    "recipe after an option": ["train", "--data", "c", "moe-gs"],
    "recipe unknown": ["train", "moegs"],
    "option missing": ["train", "moe-gs", "--data", "c"],
    "options missing": ["train", "moe-gs"],
    "option unknown": [*TRAIN, "--iteration", "5"],
    "option without its part": [*TRAIN, "--top-k", "1"],
    "option of another recipe": ["train", "scaffold-gs", "--data", "c", "--out", "r", "--scene.decoder.num", "3"],
    "option twice": [*TRAIN, "-m", "s"],
    "number is a word": [*TRAIN, "--iterations", "abc"],
    "choice unknown": [*TRAIN, "--device", "gpu"],
    "value missing": [*TRAIN, "--iterations"],
    "value for a switch": [*TRAIN, "--resume=yes"],
    "two numbers of three": [*TRAIN, "--background", "1", "1"],
    "run missing": ["eval"],
    "two runs": ["eval", "a", "b"],
    "word for a command without any": ["doctor", "a"],
}


@pytest.mark.parametrize("case", list(WORDS))
def test_words_of_the_command_line(case, tmp_path, capsys):
    code, sentence = said(capsys, *WORDS[case])
    assert code == 2
    as_recorded(case, sentence, tmp_path)
