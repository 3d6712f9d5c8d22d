"""One process and several forked ones have the same methods."""

import os
import subprocess
import sys

import pytest
import torch

from scene_experts.core.errors import InputError, RunError
from scene_experts.core.group import Alone, join, world_size
from support.groups import free_port, run_group


def test_one_process_exchanges_nothing():
    alone, value = join("cpu"), torch.ones(3)
    alone.sum(value)
    assert isinstance(alone, Alone) and alone.first and alone.size == 1 and alone.sent == 0
    assert value.tolist() == [1, 1, 1] and alone.gather(value)[0] is value
    assert alone.any(True) and not alone.any(False) and alone.smallest(4) == 4
    assert alone.agree(lambda: 5) == alone.in_turn(lambda: 5) == 5


def exchange(group, folder):
    value = torch.full((2,), float(group.rank + 1))
    assert [float(part[0]) for part in group.gather(value)] == [1, 2]
    group.sum(value)
    assert value.tolist() == [3, 3] and group.sent == 16
    assert group.any(group.rank == 1) and not group.any(False) and group.smallest(7 - group.rank) == 6
    mine = [torch.full((2, 2), group.rank), torch.tensor(group.rank == 1)]
    group.copy_from_first(mine)
    assert mine[0].sum() == 0 and not mine[1]
    group.in_turn(lambda: (folder / str(group.rank)).write_text(" ".join(sorted(os.listdir(folder)))))


def test_two_processes_exchange(tmp_path):
    assert run_group(2, exchange, tmp_path) == [0, 0]
    assert (tmp_path / "1").read_text().startswith("0")  # the second process worked after the first


LEFT = """
import os, time
from importlib import import_module
from pathlib import Path
from scene_experts.core.group import Group
group = Group("cpu")
import_module("torch.distributed.nn.functional")  # as parts of torch do
group.wait()
group.leave()

def names():
    for path in Path("/proc/self/task").glob("*/comm"):
        try:
            yield path.read_text().strip()
        except OSError:  # it ended meanwhile
            pass

until = time.monotonic() + 10  # a thread that has ended is listed for a moment
while (left := [name for name in names() if "gloo" in name]) and time.monotonic() < until:
    time.sleep(0.01)
print(left)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the threads are found in /proc")
def test_no_thread_of_the_exchange_is_left():
    """A thread of gloo that is left can abort the process when the interpreter ends."""
    one = {"RANK": "0", "WORLD_SIZE": "1", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port())}
    done = subprocess.run([sys.executable, "-c", LEFT], env=os.environ | one, check=True, capture_output=True, text=True, timeout=120)
    assert done.stdout == "[]\n"


def fail(group):
    def work():
        if group.rank == 1:
            raise InputError("no capture")

    with pytest.raises(InputError if group.rank == 1 else SystemExit, match=None if group.rank == 1 else "2"):
        group.agree(work)
    assert not torch.distributed.is_initialized()  # its threads could abort the process at its end
    os._exit(0)


def test_an_error_of_one_process_ends_all():
    assert run_group(2, fail) == [0, 0]


def lose(group):
    if group.rank == 0:
        with pytest.raises(RunError, match="lost another"):
            group.sum(torch.ones(1))
    os._exit(0)


def test_a_lost_process_is_an_error_of_the_others():
    assert run_group(2, lose) == [0, 0]


def test_a_variable_that_is_no_number_is_refused(monkeypatch):
    monkeypatch.setenv("RANK", "0")
    monkeypatch.setenv("WORLD_SIZE", "two")
    with pytest.raises(InputError, match="torchrun"):
        world_size()
