"""One training in several processes that torchrun starts."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from support.synthetic import make_capture
from support.trainings import assert_same, last_tensors

TORCHRUN = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--max-restarts", "1", "--nproc-per-node", "2"]
LIMIT = 400  # seconds


def command(folder: Path, out: Path) -> list[str]:
    words = ["-m", "scene_experts", "train", "scaffold-gs", "--data", str(folder), "--out", str(out), "--device", "cpu", "--deterministic"]
    numbers = {"iterations": 600, "batch": 2, "stop-at": 60, "save-every": 20, "preview-every": 0, "growth.adjust.interval": 20}
    return words + [word for name, value in numbers.items() for word in (f"--{name}", str(value))]


KILLED_ONCE = """
import os, signal, sys
from pathlib import Path
from scene_experts.cli import entry
from scene_experts.core.group import Group

exchange, out = Group.gather, Path(sys.argv[sys.argv.index("--out") + 1])

def exchange_or_die(group, tensor):  # in every iteration, as the training is deterministic
    if list(out.glob("checkpoints/ckpt_*")):
        os.kill(os.getpid(), signal.SIGKILL)
    return exchange(group, tensor)

if os.environ["RANK"] == "1" and os.environ["TORCHELASTIC_RESTART_COUNT"] == "0":
    Group.gather = exchange_or_die
entry()
"""
"""The command line. Its process 1 is killed in the first iteration after a checkpoint; torchrun restarts it once."""


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
    subprocess.run([sys.executable, *command(folder, tmp_path / "one")], check=True, capture_output=True, timeout=LIMIT)
    script = tmp_path / "killed_once.py"
    script.write_text(KILLED_ONCE)
    # torchrun ends the other process when it looks: by then, that has said what it lost
    words = [*TORCHRUN, "--monitor-interval", "2", str(script), *command(folder, tmp_path / "two")[2:]]
    agent = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True)
    try:
        told, _ = agent.communicate(timeout=LIMIT)
    finally:
        end(agent)
    assert agent.returncode == 0, told
    assert "resumed at iteration" in told and "lost another" in told
    assert_same(last_tensors(tmp_path / "one"), last_tensors(tmp_path / "two"))
