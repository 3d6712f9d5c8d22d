"""One training in several processes that torchrun starts."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from support.synthetic import make_capture
from support.trainings import assert_same, last_tensors

TORCHRUN = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--max-restarts", "1", "--nproc-per-node"]


def command(folder: Path, out: Path) -> list[str]:
    words = ["-m", "scene_experts", "train", "scaffold-gs", "--data", str(folder), "--out", str(out), "--device", "cpu", "--deterministic"]
    numbers = {"iterations": 600, "batch": 2, "stop-at": 200, "save-every": 40, "preview-every": 0, "growth.adjust.interval": 20}
    return words + [word for name, value in numbers.items() for word in (f"--{name}", str(value))]


def workers_of(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def end(agent: subprocess.Popen) -> None:
    """Kill what is left: torchrun, and its workers, each of which leads a process group of its own."""
    if agent.poll() is None:
        for pid in [*workers_of(agent.pid), agent.pid]:
            os.kill(pid, signal.SIGKILL)
        agent.wait(30)


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the workers are found in /proc")
def test_torchrun_restarts_a_training_that_lost_a_process(tmp_path):
    folder = make_capture(tmp_path / "capture", views=8, size=(48, 32), points=400).folder
    subprocess.run([sys.executable, *command(folder, tmp_path / "one")], check=True, capture_output=True, timeout=120)
    words = [*TORCHRUN, "2", *command(folder, tmp_path / "two")]
    agent = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True)
    try:
        began = time.monotonic()
        while not list((tmp_path / "two").glob("checkpoints/ckpt_*")) and agent.poll() is None and time.monotonic() - began < 120:
            time.sleep(0.05)
        os.kill(workers_of(agent.pid)[-1], signal.SIGKILL)
        told, _ = agent.communicate(timeout=180)
    finally:
        end(agent)
    assert agent.returncode == 0, told
    assert "resumed at iteration" in told and "lost another" in told
    assert_same(last_tensors(tmp_path / "one"), last_tensors(tmp_path / "two"))
