"""Run Python with the pretended CUDA device.

    python benchmarks/pretended_cuda/start.py benchmarks/kernels_cuda.py --count 1000

Needs Linux, gcc, torch built for CUDA with the packages that it depends on, Triton, and gsplat built for that torch (tools/gpu_parts.py).
No number that a kernel computes is right. Where the host waits for one, it gets PRETENDED_ANSWER (default: 100).
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "build" / "pretended_cuda"
MARK = "PRETENDED_CUDA"  # the environment variable that names the library in a process that has it


def explain_missing() -> str | None:
    """Return None if this Python can run with the device, otherwise what is missing."""
    import torch

    if sys.platform != "linux" or shutil.which("gcc") is None:
        return "gcc on Linux is needed to build the pretended device"
    if torch.version.cuda is None:
        return f"torch {torch.__version__} is built without CUDA: use a Python with torch for CUDA"
    if find_headers() is None:
        return f"CUDA's headers of {torch.version.cuda} are missing: set CUDA_HOME to a toolkit of that release"
    return None


def find_headers() -> Path | None:
    """The headers of the CUDA release that torch is built for; structures differ between releases."""
    import torch

    major = (torch.version.cuda or "").partition(".")[0]
    places = [
        *(Path(torch.__file__).parents[1] / "nvidia").glob("*/include"),
        Path(os.environ.get("CUDA_HOME", "/usr/local/cuda")) / "include",
    ]
    for place in places:
        header = place / "cuda.h"
        found = re.search(r"#define CUDA_VERSION (\d+)\d{3}\b", header.read_text()) if header.is_file() else None
        if found and found.group(1) == major and (place / "crt" / "host_defines.h").is_file():
            return place
    return None


def build() -> list[Path]:
    """Compile the libraries unless they are there, and return them. torch and Triton find them by the names of NVIDIA's."""
    import torch

    sources = sorted(Path(__file__).parent.glob("*.c"))
    newest = max(path.stat().st_mtime for path in Path(__file__).parent.iterdir() if path.is_file())
    made = {"libcuda.so.1": [path for path in sources if path.name != "nvrtc.c"]}
    made[f"libnvrtc.so.{(torch.version.cuda or '').partition('.')[0]}"] = [path for path in sources if path.name == "nvrtc.c"]
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name, files in made.items():
        library = FOLDER / name
        if library.is_file() and library.stat().st_mtime > newest:
            continue
        unfinished = library.with_suffix(f".{os.getpid()}")
        flags = ["-O2", "-shared", "-fPIC", "-fvisibility=hidden", f"-Wl,-soname,{name}", f"-I{find_headers()}"]
        subprocess.run(["gcc", *flags, *map(str, files), "-o", str(unfinished), "-ldl", "-lpthread"], check=True)
        unfinished.replace(library)
    return [FOLDER / name for name in made]


def make_environment(answer: int | None = None) -> dict[str, str]:
    """The environment of a process with the device. answer: The number that the host gets wherever it waits for one."""
    libraries = build()
    variables = {"LD_PRELOAD": ":".join(map(str, libraries)), "TRITON_LIBCUDA_PATH": str(FOLDER), "OMP_NUM_THREADS": "1"}
    variables[MARK] = str(libraries[0])
    variables["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT / "src"), str(ROOT / "benchmarks"), os.environ.get("PYTHONPATH", "")]))
    if answer is not None:
        variables["PRETENDED_ANSWER"] = str(answer)
    return os.environ | variables


def enter(answer: int | None = None) -> None:
    """Start this process anew with the device, unless it has it. Exits with one sentence where that is not possible."""
    if MARK in os.environ:
        return
    if (reason := explain_missing()) is not None:
        raise SystemExit(reason)
    os.execve(sys.executable, [sys.executable, *sys.argv], make_environment(answer))


def main(words: list[str]) -> None:
    if not words:
        raise SystemExit("expected what to run, found nothing; for example: start.py benchmarks/kernels_cuda.py")
    if (reason := explain_missing()) is not None:
        raise SystemExit(reason)
    answer = int(os.environ.get("PRETENDED_ANSWER", "100"))
    os.execve(sys.executable, [sys.executable, *words], make_environment(answer))


if __name__ == "__main__":
    main(sys.argv[1:])
