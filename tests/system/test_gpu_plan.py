"""`make gpu`: its plan, its stages and its parts, without a GPU."""

import importlib.util
import json
import os
import subprocess
import sys
import tarfile
import time
from pathlib import Path

import pytest

from scene_experts.training.recipes import RECIPES
from support.places import ROOT
from support.pretend.start import explain_missing, make_environment
from support.synthetic import make_capture


def load(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / "tools" / f"{name}.py")
    assert spec and spec.loader
    module = sys.modules[name] = importlib.util.module_from_spec(spec)  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


gpu = load("gpu")
gpu_parts = load("gpu_parts")

STAGES = [
    gpu.Stage("one", "First", ("a",), 50),
    gpu.Stage("two", "Second", ("b",), 50, timed=True),
    gpu.Stage("three", "Third", ("c",), 50),
]


def soon(seconds=1000.0):
    return time.monotonic() + seconds


@pytest.mark.parametrize("sizes", [None, gpu.TINY])
def test_the_plan_names_files_and_recipes_that_exist(sizes):
    stages = gpu.list_stages(Path("capture"), Path("work"), Path("trainings"), sizes)
    assert [stage.name for stage in stages] == ["machine", "tests", "kernels", "decode", "steps", "eval", "train", "together"]
    for stage in stages:
        for word in stage.command:
            assert not word.endswith(".py") or (ROOT / word).is_file(), word
    named = {*gpu.TIMED, *(case.partition("@")[0] for case in gpu.PHASES)}
    assert named <= set(RECIPES)
    assert [stage.name for stage in gpu.list_stages(Path("capture"), Path("work"), None, sizes)] == [stage.name for stage in stages[:-1]]


@pytest.mark.slow
def test_every_benchmark_knows_the_words_that_it_gets(capsys):
    for module in ("kernels_cuda", "decode_cuda", "profile_cuda", "eval_cuda", "train_cuda", "train_together"):
        done = subprocess.run([sys.executable, f"benchmarks/{module}.py", "--help"], cwd=ROOT, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        for sizes in (None, gpu.TINY):
            for stage in gpu.list_stages(Path("capture"), Path("work"), Path("trainings"), sizes):
                if f"benchmarks/{module}.py" in stage.command:
                    words = [*stage.command, *(["--seconds"] if stage.timed else [])]
                    assert not [word for word in words if word.startswith("--") and word not in done.stdout], module


def test_what_succeeded_is_not_run_again_and_a_failure_does_not_stop_the_rest(tmp_path, capsys):
    calls, work, out = [], tmp_path / "work", tmp_path / "out"
    work.mkdir()

    def run(stage, seconds, show):
        calls.append(stage.name)
        assert seconds <= 50
        show(f"output of {stage.name}\n")
        if stage.name == "two":
            show("to do: more\n" if calls.count("two") == 1 else "all done\n")
        return 1 if stage.name == "three" and calls.count("three") == 1 else 0

    assert gpu.run_stages(STAGES, work, out, soon(1), run) == ["one", "two", "three"] and not calls
    assert gpu.run_stages(STAGES, work, out, soon(), run) == ["two", "three"]
    (out / "log.txt").unlink()  # a machine that is lent empties the folder
    assert gpu.run_stages(STAGES, work, out, soon(), run) == []
    assert calls == ["one", "two", "three", "two", "three"]
    assert "output of one" in capsys.readouterr().out and "three: exit 1" in (out / "log.txt").read_text()
    assert {name: state["end"] for name, state in json.loads((out / "stages.json").read_text()).items()} == dict.fromkeys(
        ("one", "two", "three"), "done"
    )


def test_few_small_files_travel(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(gpu, "LARGEST", 1000)
    for name, size in (("log.txt", 10), ("train/results.json", 10), ("together/scores.zip", 2000), ("together/a/ckpt_1.safetensors", 10)):
        path = tmp_path / "work" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(bytes(size))
    gpu.collect(tmp_path / "work", tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["log.txt", "train.json"]
    assert "scores.zip" in capsys.readouterr().out


def test_a_command_that_takes_too_long_is_ended_with_its_children():
    child = "import subprocess, sys; subprocess.run([sys.executable, '-c', 'import time; print(1, flush=True); time.sleep(600)'])"
    slow = gpu.Stage("slow", "Slow", (sys.executable, "-c", child), 600)
    for seconds in (2, 10, 60):  # a busy machine may need longer to begin
        shown = []
        assert gpu.run_command(slow, seconds, shown.append) == 124
        if shown:
            break
    assert shown == ["1\n"]  # and the pipe is closed: nothing holds it open


@pytest.mark.parametrize("code", [0, 3])
def test_the_exit_code_and_output_of_a_command(code):
    shown = []
    stage = gpu.Stage("quick", "Quick", (sys.executable, "-c", f"print('out'); raise SystemExit({code})"), 60)
    assert gpu.run_command(stage, 60, shown.append) == code and shown == ["out\n"]


def test_stages_can_be_chosen_and_an_unknown_one_is_refused(capsys, tmp_path):
    line = ["--data", str(tmp_path), "--out", str(tmp_path), "--plan"]
    assert gpu.main([*line, "--stages", "decode", "eval"]) == 0
    assert [words.split()[0] for words in capsys.readouterr().out.splitlines()] == ["decode", "eval"]
    with pytest.raises(SystemExit, match="found together"):  # without --trainings there is none
        gpu.main([*line, "--stages", "together"])


def test_the_index_of_a_kernel_names_the_folder_where_it_was_unpacked(tmp_path):
    folder = tmp_path / "made" / "KEY"
    folder.mkdir(parents=True)
    (folder / "place.cubin").write_bytes(b"code")
    (folder / "__grp__place.json").write_text(json.dumps({"child_paths": {"place.cubin": str(folder / "place.cubin")}}))
    with tarfile.open(tmp_path / "cache.tar.xz", "w:xz") as archive:
        archive.add(folder, "KEY")
    gpu.unpack_cache(tmp_path / "cache.tar.xz", tmp_path / "here")
    found = json.loads((tmp_path / "here" / "KEY" / "__grp__place.json").read_text())["child_paths"]["place.cubin"]
    assert Path(found) == tmp_path / "here" / "KEY" / "place.cubin" and Path(found).read_bytes() == b"code"


def test_parts_for_another_machine_are_noticed(tmp_path):
    assert gpu.find_differences(tmp_path) == ""
    (tmp_path / "parts.json").write_text(json.dumps(gpu.list_versions()))
    assert gpu.find_differences(tmp_path) == ""
    (tmp_path / "parts.json").write_text(json.dumps(gpu.list_versions() | {"torch": "1.0"}))
    assert gpu.find_differences(tmp_path).startswith("torch 1.0, not ")


def test_parts_that_are_too_large_to_travel_are_refused(tmp_path, monkeypatch, capsys):
    (tmp_path / "capture").mkdir()
    (tmp_path / "capture" / "photo").write_bytes(bytes(3 << 20))
    gpu_parts.check_size(tmp_path)
    assert "3.0 MiB" in capsys.readouterr().out
    monkeypatch.setattr(gpu_parts, "MOST", 2 << 20)
    with pytest.raises(SystemExit, match=r"below 2 MiB, found 3 \(capture 3\)"):
        gpu_parts.check_size(tmp_path)


def test_the_rasteriser_is_built_for_the_channels_that_are_used():
    text = "__INS__(1)\n__INS__(3)\n    __LAUNCH_KERNEL__(4)\n    __LAUNCH_KERNEL__(16)\nother(5)"
    assert gpu_parts.restrict(text) == "__INS__(3)\n    __LAUNCH_KERNEL__(4)\nother(5)"


@pytest.mark.slow
def test_the_benchmarks_run_at_tiny_sizes_on_tensors_that_pretend(tmp_path):
    if (reason := explain_missing()) is not None:
        pytest.skip(reason)
    capture = make_capture(tmp_path / "capture", views=4, size=(24, 16), points=40)
    environment = make_environment(tmp_path)
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT / "benchmarks"), environment["PYTHONPATH"]])
    text = ""
    for stage in gpu.list_stages(capture.folder, tmp_path / "work", None, gpu.TINY):
        if stage.name in ("kernels", "decode", "train"):
            python, *words = stage.command
            command = [python, "-m", "support.pretend.script", *words, *(["--seconds", "290"] if stage.timed else [])]
            done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
            assert done.returncode == 0, done.stderr[-2000:]
            text += done.stdout
    for row in ("plain gsplat", "L1 + SSIM, Triton", "Top-2 of 5", "gsplat, ", "all done", *gpu.TIMED):
        assert row in text
