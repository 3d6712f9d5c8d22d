"""Run a function in several processes that form a group, as `torchrun` would start them."""

import multiprocessing
import os
import socket
from collections.abc import Callable
from typing import Any

from scene_experts.core.group import Alone, join


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def run_group(size: int, work: Callable[..., Any], *args: Any, timeout: float = 300.0) -> list[int | None]:
    """Call `work(group, *args)` in `size` forked processes. Returns their exit codes; 0 is success.

    The processes are forked, so that they need not import torch again.
    """
    port = free_port()
    context = multiprocessing.get_context("fork")
    members = [context.Process(target=_member, args=(rank, size, port, work, args)) for rank in range(size)]
    for member in members:
        member.start()
    for member in members:
        member.join(timeout)
    for member in members:
        if member.is_alive():
            member.kill()
            member.join()
    return [member.exitcode for member in members]


def _member(rank: int, size: int, port: int, work: Callable[..., Any], args: tuple) -> None:
    os.environ |= {"RANK": str(rank), "LOCAL_RANK": str(rank), "WORLD_SIZE": str(size)}
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    group: Alone = join("cpu")
    work(group, *args)
    group.leave()
