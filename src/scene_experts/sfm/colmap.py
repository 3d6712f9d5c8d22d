"""Runs COLMAP in a process of its own, and tells what it says."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from scene_experts.core.errors import InputError, RunError
from scene_experts.core.extras import install_line
from scene_experts.core.io import write_bytes
from scene_experts.core.progress import Progress

Say = Callable[[str], None]
WORKER = "scene_experts.sfm.worker"
ROOT = Path(__file__).parents[2]  # where it is found
START = """
import runpy, sys
sys.path.insert(0, {root!r})
import {worker}  # of the same version, whatever is installed
del sys.path[0]  # where it is the folder of all packages, none may hide a standard module
runpy.run_module({worker!r}, run_name="__main__")
"""


def run_worker(request: dict[str, Any], log: Path, say: Say, progress: Progress) -> dict[str, Any]:
    """Run COLMAP in a process of its own (`worker`) and return its last message.

    Raises InputError if pycolmap cannot be used, RunError if the worker fails.
    """
    environment = {**os.environ, "OMP_NUM_THREADS": str(request["threads"])}
    start = START.format(root=str(ROOT), worker=WORKER)
    with log.open("a") as stream:
        # -P: modules are not searched in the current folder. In a new session, because this process
        # handles Ctrl-C.
        process = subprocess.Popen(
            [sys.executable, "-P", "-c", start],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stream, text=True, env=environment, start_new_session=True,
        )  # fmt: skip
        assert process.stdin is not None and process.stdout is not None
        last: dict[str, Any] = {}
        try:
            with suppress(BrokenPipeError):  # a worker that died at once: its exit code says so
                process.stdin.write(json.dumps(request) + "\n")
                process.stdin.flush()  # it stays open: the worker ends when this process does, however it ends
            for line in process.stdout:
                last = json.loads(line)
                tell(last, say, progress)
            code = process.wait()
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()
            with suppress(BrokenPipeError):
                process.stdin.close()
    if last.get("step") == "missing":
        raise InputError(f"pycolmap cannot be imported ({last['why']}): {install_line('sfm')}")
    if code != 0 or last.get("step") != "done":
        check_space(log.parent)
        if code == -signal.SIGKILL:
            raise RunError("COLMAP was killed, most often because the memory is full; close other programs, or give a smaller --max-side")
        raise RunError(f"COLMAP failed with exit code {code}: {last_log_line(log)}; its log is {log}")
    return last


def tell(message: dict[str, Any], say: Say, progress: Progress) -> None:
    """Pass on one message of the worker."""
    step = message["step"]
    if "total" in message:
        progress(step, message["done"], message["total"])
    elif step == "failed":
        say(f"the {message['mapper']} mapper failed: {message['why']}")
    elif step == "next mapper":
        apart = f" in the largest of {message['parts']} parts, which do not fit together" if message["parts"] > 1 else ""
        posed = f"gave {message['posed']} of {message['photographs']} photographs a pose{apart}"
        say(f"the {message['mapper']} mapper {posed}; the global mapper runs too, and the better result is kept")
    elif step == "one first":
        why = "no two pictures show the same points from clearly different directions: " if message["narrow"] else ""
        say(f"{why}one focal length and the global mapper come first")
    elif step == "stretched":
        say(f"COLMAP found a lens with two focal lengths, one {message['ratio']:.2f} times the other: it is sought again with one")
    elif step == "one focal length":
        fits = "one focal length fits as well and is kept"
        stays = "warning: one focal length does not fit as well, so two are kept; if no lens stretched the pictures, the scene is stretched"
        say(fits if message["kept"] else "they do not fit: two focal lengths are tried, too" if message["first"] else stays)
    elif step == "weak":
        say(f"{message['photographs']} photographs fit too few others; {message['pairs']:,} more pairs are matched for them")
    elif step == "unread":
        say(f"warning: COLMAP cannot read {', '.join(message['names'])}")


def check_space(folder: Path) -> None:
    """Raise RunError if a file of 1 MiB cannot be written to `folder`. COLMAP's own messages do not
    say that the disk is full."""
    probe = folder / ".probe"
    try:
        write_bytes(probe, bytes(1 << 20))
    finally:
        probe.unlink(missing_ok=True)


def last_log_line(log: Path) -> str:
    """Return the last line that COLMAP logged, without its time and source location."""
    lines = [line.strip() for line in log.read_text(errors="replace").splitlines() if line.strip()]
    lines = [line for line in lines if not line.startswith(("@", "***", "PC:"))]  # a stack trace
    return lines[-1].rpartition("] ")[2] if lines else "it logged nothing"
