"""Runs and captures survive a full disk and a killed process."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from scene_experts import cli
from scene_experts.core import checkpoint
from support.synthetic import make_capture


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    return make_capture(tmp_path_factory.mktemp("capture"), views=12, size=(48, 32), points=300).folder


def arguments(capture: Path, out: Path, *more: object) -> list[str]:
    fixed = ["--iterations", "600", "--preview-every", "0", "--deterministic"]
    return ["train", "moe-gs", "--data", str(capture), "--out", str(out), *fixed, *map(str, more)]


def command(args: list[str]) -> list[str]:
    return [sys.executable, "-m", "scene_experts", *args]


def newest(out: Path) -> tuple[int, dict[str, torch.Tensor]]:
    path = checkpoint.latest(out / "checkpoints")
    assert path is not None
    tensors, meta = checkpoint.load(path)
    return meta["step"], tensors


@pytest.mark.slow
def test_a_disk_that_fills_up_while_saving(capture, tmp_path):
    """Files may not grow beyond half a checkpoint: one sentence, exit code 1, the checkpoint before loads and the run goes on from it."""
    assert cli.main(arguments(capture, tmp_path, "--stop-at", 10)) == 0
    last = tmp_path / "checkpoints" / "ckpt_000010.safetensors"
    whole = last.read_bytes()

    def full() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (len(whole) // 2, len(whole) // 2))

    args = arguments(capture, tmp_path, "--resume", "--stop-at", 40, "--save-every", 5)
    done = subprocess.run(command(args), preexec_fn=full, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 1 and "Traceback" not in done.stderr, done.stderr
    (sentence,) = [line for line in done.stderr.splitlines() if line.startswith("error:")]
    assert "ckpt_000015" in sentence
    assert [p.name for p in (tmp_path / "checkpoints").iterdir()] == [last.name] and last.read_bytes() == whole
    assert cli.main(arguments(capture, tmp_path, "--resume", "--stop-at", 16)) == 0
    assert newest(tmp_path)[0] == 16
    steps = [json.loads(line)["step"] for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert steps == sorted(steps) and steps[-1] == 16


@pytest.mark.slow
def test_killed_while_it_saves_the_run_goes_on_as_if_nothing_had_happened(capture, tmp_path):
    """SIGKILL, twice, in a training that saves after every iteration; the end is bit for bit that of a run left alone."""
    out, reached = tmp_path / "killed", 0
    for kill in range(2):
        args = arguments(capture, out, "--save-every", 1, *(["--resume"] if kill else []))
        process = subprocess.Popen(command(args), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        while process.poll() is None:
            steps = [int(p.stem[5:]) for p in (out / "checkpoints").glob("ckpt_*.safetensors")]
            if steps and max(steps) >= reached + 12:
                break
            time.sleep(0.003)
        process.kill()
        assert process.communicate()[1].count("error") == 0 and process.returncode == -9
        step, _ = newest(out)
        assert step >= reached + 11, "at most the iteration in hand is lost"
        reached = step
    end = reached + 5
    assert cli.main(arguments(capture, out, "--resume", "--stop-at", end)) == 0
    assert not list(out.rglob("*.part"))
    assert cli.main(arguments(capture, tmp_path / "alone", "--stop-at", end)) == 0
    torch.use_deterministic_algorithms(False)
    (a, killed), (b, alone) = newest(out), newest(tmp_path / "alone")
    assert a == b == end and killed.keys() == alone.keys()
    assert all(torch.equal(killed[name], alone[name]) for name in alone)


def run_with_full_disk(args: list[str], largest: int) -> str:
    """Run a command whose files may not grow beyond `largest` bytes, and return its one error sentence."""

    def full() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (largest, largest))

    done = subprocess.run(command(args), preexec_fn=full, capture_output=True, text=True, check=False, timeout=400)
    assert done.returncode == 1 and "Traceback" not in done.stderr, done.stderr
    (sentence,) = [line for line in done.stderr.splitlines() if line.startswith("error:")]
    return sentence


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
def test_a_disk_that_fills_up_while_evaluating_or_reporting(capture, tmp_path):
    """The scores, pictures and page of the evaluation before are unchanged; without one, nothing is left."""
    assert cli.main(arguments(capture, tmp_path, "--stop-at", 2)) == 0
    trained = contents(tmp_path)
    assert "cannot write" in run_with_full_disk(["eval", str(tmp_path), "--no-lpips"], 2000)
    assert contents(tmp_path) == trained
    assert cli.main(["eval", str(tmp_path), "--no-lpips"]) == 0
    before = contents(tmp_path)
    assert {"results.json", "per_view.json", "report.html"} <= before.keys()
    largest = max(len(data) for name, data in before.items() if name.endswith(".png"))
    for args, limit in ((["eval", str(tmp_path), "--no-lpips"], largest - 1), (["report", str(tmp_path)], largest)):
        assert "cannot write" in run_with_full_disk(args, limit)
        assert contents(tmp_path) == before


@pytest.mark.slow
def test_a_disk_that_fills_up_while_making_a_capture(tmp_path):
    """Photographs that cannot be copied, and a database that COLMAP cannot write: no capture, and the photographs are unchanged."""
    pytest.importorskip("pycolmap")
    (tmp_path / "photos").mkdir()
    noise = np.random.default_rng(0)
    for name in "abc":
        Image.fromarray(noise.integers(0, 255, (48, 64, 3), np.uint8)).save(tmp_path / "photos" / f"{name}.png")
    photos, out = contents(tmp_path / "photos"), tmp_path / "made"
    size = max(map(len, photos.values()))
    for limit in (size // 2, size + 1000):
        sentence = run_with_full_disk(["capture", str(tmp_path / "photos"), "--out", str(out)], limit)
        assert "cannot write" in sentence and "free some space" in sentence
        assert contents(tmp_path / "photos") == photos
        assert [path.name for path in out.iterdir()] == [".capture"] and not list(out.rglob("*.part"))
