"""The command line: help, one-sentence errors, exit codes."""

import io
import json
import re
import signal
import struct
import subprocess
import sys
import time
import warnings
from pathlib import Path

import pytest

from scene_experts import cli
from scene_experts.commands import COMMANDS
from scene_experts.commands.train import parse_train
from scene_experts.training.recipes import RECIPES
from support.golden import recorded_text
from support.synthetic import make_capture


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    return make_capture(tmp_path_factory.mktemp("cli"), views=9, size=(48, 32)).folder


def run(capsys, *args: str) -> tuple[int, str, str]:
    code = cli.main(list(args))
    out, err = capsys.readouterr()
    return code, out, err


def fails(capsys, *args: str) -> str:
    """Runs a command that must fail with exit code 2 and one sentence."""
    code, _, err = run(capsys, *args)
    lines = [line for line in err.strip().splitlines() if line.startswith("error:")]
    assert code == 2 and len(lines) == 1 and "Traceback" not in err, (code, err)
    return lines[0]


def test_help_is_what_was_reviewed(capsys):
    code, out, _ = run(capsys, "--help")
    assert code == 0 and out == recorded_text("help.txt", out), "look at the change, then run `make record-flags`"


def test_no_flag_goes_without_review(capsys):
    """Every flag of a command or a recipe once. A new flag needs no record."""
    found: set[str] = set()
    commands = [*(name for name in COMMANDS if name not in ("train", "blocks")), "blocks plan", "blocks merge"]
    for words in [*commands, *(f"train {name}" for name in RECIPES)]:
        code, out, _ = run(capsys, *words.split(), "--help-all")
        names = [line[2:].split("  ")[0] for line in out.splitlines() if line.startswith("  -")]
        found |= {flag for name in names for flag in re.findall(r"--[\w.-]+", name)}
        assert code == 0, words
    known = set(recorded_text("flags.txt", "".join(f"{flag}\n" for flag in sorted(found))).split())
    assert known - found == set(), "look at the flags that went, then run `make record-flags`"


def test_help_and_version_do_not_load_torch():
    words = [["--help"], ["--version"], *([name, "--help"] for name in COMMANDS if name not in LOADS_TORCH)]
    probe = f"import sys, scene_experts.cli as c; [c.main(words) for words in {words}]; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", probe], capture_output=True, check=False).returncode == 0


LOADS_TORCH = ("train",)
"""Commands whose help loads torch: the options of `train` are those of its recipes."""


@pytest.mark.parametrize("command", list(COMMANDS))
def test_every_command_has_help_in_plain_text_for_80_columns(command, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    for words in ([command, "--help"], [command, "-h"], [command, "--help-all"], ["help", command]):
        code, out, _ = run(capsys, *words)
        assert code == 0 and out.startswith(f"usage: scene-experts {command}") and plain(out)
        assert max(map(len, out.splitlines())) <= 80


def plain(text: str) -> bool:
    """Whether a text has no frames and no colours."""
    return not re.search(r"[\u2500-\u259f\x1b]", text)


WRONG = {
    "nothing": [],
    "an unknown option": ["--xyzzy"],
    "an unknown letter": ["-x"],
    "a nearly known option": ["--devise", "cpu"],
    "an option without its value": ["--seed"],
    "two options without values": ["--out", "--step"],
    "an empty word": [""],
    "an empty value": ["--out="],
    "too many words": ["a", "b", "c", "--out"],
    "a value of the wrong type": ["a", "--step", "abc", "--seed", "abc", "--seconds", "abc", "--max-views", "abc", "--threads", "abc"],
    "a choice that is none": ["a", "--device", "gpu", "--format", "gpu", "--init", "gpu", "--matching", "gpu"],
    "an option twice": ["a", "--out", "b", "--out", "c", "--data", "d", "--data", "e", "--threads", "1", "--threads", "1"],
    "a switch with a value": ["a", "--overwrite=yes", "--lpips=no", "--dry-run=1", "--mixed=1", "--list=1"],
}


@pytest.mark.parametrize("case", list(WRONG))
@pytest.mark.parametrize("command", [*(name for name in COMMANDS), "train moe-gs", "train 3dgs", "trian", "train moegs"])
def test_words_that_do_not_fit_are_one_sentence(command, case, capsys):
    """Some of these options are valid for some commands. No command can succeed, because the files do not exist."""
    if (command, case) in RUNS_WITHOUT_WORDS:
        return
    code, out, err = run(capsys, *command.split(), *WRONG[case])
    assert code == 2 and err.startswith("error: ") and err.count("\n") == 1 and plain(err) and not out, err


RUNS_WITHOUT_WORDS = {(command, "nothing") for command in ("bench", "catalog", "doctor")}


def test_unknown_command_recipe_and_flag(capsys):
    code, _, err = run(capsys, "trian")
    assert code == 2 and "'trian'" in err and "'train'" in err
    assert "'moe-gs'" in fails(capsys, "train", "moegs")
    sentence = fails(capsys, "train", "scaffold-gs", "--data", "x", "--out", "y", "--scene.decoder.top-k", "1")
    assert "--scene.decoder.top-k" in sentence and "moe-gs" in sentence
    assert "'--iterations'" in fails(capsys, "train", "moe-gs", "--data", "x", "--out", "y", "--iteration", "5")
    assert run(capsys)[0] == 2


def test_warnings_about_the_metadata_of_photographs_are_not_shown(capsys):
    with warnings.catch_warnings(record=True) as seen:
        fails(capsys, "info", "nothing_here")
        warnings.warn_explicit("Corrupt EXIF data", UserWarning, "TiffImagePlugin.py", 1, module="PIL.TiffImagePlugin")
        warnings.warn_explicit("another", UserWarning, "a.py", 1, module="a")
    assert [str(warning.message) for warning in seen] == ["another"]


def test_flags_reach_the_configuration():
    made = parse_train(
        ["moe-gs", "-s", "c", "-m", "r", "--scene.decoder.top-k", "1", "--iterations", "7000", "--loss.load", "0.5", "-r", "factor:2"]
    )
    assert made.cfg.scene.decoder.top_k == 1 and made.cfg.iterations == 7000 and made.cfg.loss.load == 0.5
    assert made.data.path == Path("c") and made.out == Path("r") and made.data.resolution == "factor:2"
    assert made.cfg.recipe == "moe-gs" and parse_train(["scaffold-gs", "-s", "c", "-m", "r"]).cfg == RECIPES["scaffold-gs"][1]


@pytest.mark.slow
def test_train_eval_compare_export_import(capsys, capture, tmp_path):
    for recipe in ("scaffold-gs", "moe-gs"):
        args = ("train", recipe, "--data", str(capture), "--out", str(tmp_path / recipe), "--iterations", "30")
        assert run(capsys, *args, "--preview-every", "30")[0] == 0
        assert run(capsys, "eval", str(tmp_path / recipe), "--no-lpips")[0] == 0
    moe = tmp_path / "moe-gs"
    results = json.loads((moe / "results.json").read_text())
    assert results["psnr"] > 5 and (moe / "previews" / "000030.png").is_file() and (moe / "cameras.json").is_file()
    assert (moe / "point_cloud" / "iteration_30" / "point_cloud.ply").is_file()
    code, out, _ = run(capsys, "compare", str(tmp_path / "scaffold-gs"), str(moe), "--format", "markdown")
    assert code == 0 and "moe-gs" in out and "scaffold-gs" in out
    assert "--resume" in fails(capsys, "train", "moe-gs", "--data", str(capture), "--out", str(moe), "--iterations", "30")
    other = fails(capsys, "train", "scaffold-gs", "--data", str(capture), "--out", str(moe), "--iterations", "30", "--resume")
    assert "moe-gs" in other
    assert run(capsys, "export", str(moe), "--format", "compact")[0] == 0
    compact = moe / "scene.compact"
    for source in (compact, moe):
        out_folder = tmp_path / f"from_{source.name}"
        assert run(capsys, "import", str(source), "--data", str(capture), "--out", str(out_folder))[0] == 0
        assert run(capsys, "eval", str(out_folder), "--no-lpips")[0] == 0
        again = json.loads((out_folder / "results.json").read_text())
        assert again["psnr"] == pytest.approx(results["psnr"], abs=0.02)


def test_bad_runs(capsys, capture, tmp_path):
    assert "config.json" in fails(capsys, "eval", str(tmp_path))
    assert "config.json" in fails(capsys, "export", str(tmp_path / "absent"))
    run_folder = tmp_path / "run"
    assert run(capsys, "train", "moe-gs", "--data", str(capture), "--out", str(run_folder), "--iterations", "10")[0] == 0
    newest = next((run_folder / "checkpoints").glob("*.safetensors"))
    whole = newest.read_bytes()
    newest.write_bytes(whole[: len(whole) // 2])
    assert "checkpoint" in fails(capsys, "eval", str(run_folder))
    newest.write_bytes(whole)
    config = json.loads((run_folder / "config.json").read_text())
    config["train"]["loss"]["load"] = "much"
    (run_folder / "config.json").write_text(json.dumps(config))
    assert "config.train.loss.load" in fails(capsys, "eval", str(run_folder))
    assert (
        run(capsys, "train", "moe-gs", "--data", str(capture), "--out", str(tmp_path / "none"), "--iterations", "10", "--split", "none")[0]
        == 0
    )
    assert run(capsys, "eval", str(tmp_path / "none"), "--no-lpips")[0] == 0


def test_bad_captures(capsys, capture, tmp_path):
    assert "absent" in fails(capsys, "info", str(tmp_path / "absent"))
    broken = tmp_path / "broken" / "sparse" / "0"
    broken.mkdir(parents=True)
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        (broken / name).write_bytes(struct.pack("<Q", 5))
    assert "cameras.bin" in fails(capsys, "train", "moe-gs", "--data", str(tmp_path / "broken"), "--out", str(tmp_path / "r"))
    assert not (tmp_path / "r").exists()
    assert "--iterations" in fails(capsys, "train", "moe-gs", "--data", str(capture), "--out", str(tmp_path / "r"), "--iterations", "0")


@pytest.mark.slow
def test_a_signal_saves_and_ends_cleanly(capture, tmp_path):
    args = [
        sys.executable,
        "-m",
        "scene_experts",
        "train",
        "moe-gs",
        "--data",
        str(capture),
        "--out",
        str(tmp_path),
        "--iterations",
        "20000",
    ]
    metrics = tmp_path / "metrics.jsonl"
    for number, flags in ((signal.SIGINT, []), (signal.SIGTERM, ["--resume"])):
        before = metrics.stat().st_size if metrics.exists() else 0
        process = subprocess.Popen([*args, *flags], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        while process.poll() is None and not (metrics.exists() and metrics.stat().st_size > before):
            time.sleep(0.1)
        process.send_signal(number)
        out, _ = process.communicate(timeout=400)
        assert process.returncode == 128 + number and "--resume" in out and "Traceback" not in out, out
        step = int(re.search(r"iteration ([\d,]+)[^\n]*--resume", out)[1].replace(",", ""))
        assert (tmp_path / "checkpoints" / f"ckpt_{step:06d}.safetensors").is_file()
    again = [*args, "--resume", "--stop-at", str(step + 5)]
    done = subprocess.run(again, capture_output=True, text=True, check=False, timeout=400)
    assert done.returncode == 0 and f"iteration {step:,}" in done.stdout, done.stdout + done.stderr


def test_a_file_that_cannot_be_used_is_one_sentence(capsys, monkeypatch):
    from scene_experts import commands

    monkeypatch.setattr(commands, "run", lambda *_: (_ for _ in ()).throw(PermissionError(13, "Permission denied", "a/b")))
    code, _, err = run(capsys, "info", "x")
    assert code == 1 and "a/b: permission denied" in err and err.count("\n") == 1


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: 1 byte\nmore")])
def test_too_little_memory_is_one_sentence(error, capsys, monkeypatch):
    from scene_experts import commands

    def fail(*_):
        raise error

    monkeypatch.setattr(commands, "run", fail)
    code, _, err = run(capsys, "info", "x")
    assert code == 1 and "memory" in err and err.count("\n") == 1
    monkeypatch.setattr(commands, "run", lambda *args: (_ for _ in ()).throw(RuntimeError("a fault of ours")))
    with pytest.raises(RuntimeError):
        cli.main(["info"])


def test_names_that_the_terminal_cannot_write_end_no_work(capture, tmp_path, monkeypatch):
    written = io.BytesIO()
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(written, encoding="ascii"))
    out = tmp_path / "früh"
    words = ["--data", str(capture), "--out", str(out), "--iterations", "1", "--preview-every", "0", "--device", "cpu"]
    assert cli.main(["train", "scaffold-gs", *words]) == 0
    sys.stdout.flush()
    assert rb"fr\xfch" in written.getvalue() and (out / "point_cloud/iteration_1/point_cloud.ply").is_file()
