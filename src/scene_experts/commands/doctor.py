"""Checks which backends work on this machine, why the others do not, and what to install."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import platform
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from rich.console import Console

from scene_experts.core.errors import InputError
from scene_experts.core.extras import install_line
from scene_experts.data.store import available_bytes
from scene_experts.native import library as native

PIN = "keep torch as it is with `pip install -c constraints.txt ...`, run in the project's folder"
EXTRAS = {
    "sfm": ("pycolmap", "camera poses of photographs and videos (capture)"),
    "exr": ("OpenEXR", "EXR photographs"),
    "heic": ("pillow_heif", "HEIC photographs of phones (capture)"),
    "viewer": ("viser", "the viewer (view, train --viewer)"),
    "video": ("imageio_ffmpeg", "videos (render --out FILE.mp4, capture VIDEO)"),
    "spz4": ("zstandard", "SPZ files of version 4 (import)"),
    "usd": ("pxr", "OpenUSD files (export --format usd, import)"),
    "mesh": ("skimage", "meshes (export --format mesh)"),
    "plots": ("matplotlib", "figures (reproduce)"),
    "tensorboard": ("tensorboard", "TensorBoard (train --tensorboard)"),
    "cluster": ("distributed", "runs on several machines (reproduce --cluster)"),
    "docs": ("mkdocs", "this project's documentation (make docs)"),
    "test": ("pytest", "this project's tests (make test)"),
}
"""Optional packages of pyproject.toml by the name of their extra: the module, and what it is for.
`cuda` has checks of its own."""


@dataclass(frozen=True)
class Check:
    """One line of the report."""

    name: str
    ok: bool
    found: str  # version, level, or why it is missing
    fix: str = ""  # what to install or run; empty if nothing is missing
    needed: bool = False  # required for training


def diagnose() -> list[Check]:
    """Run all checks. They install, download and change nothing, and raise no exception."""
    checks: dict[str, Callable[[], Check]] = {
        "Python": python,
        "torch": pytorch,
        "CUDA": cuda,
        "CPU library": native_library,
        "gsplat": gsplat,
        "triton": triton,
        "cores": machine,
        "memory": memory,
        "LPIPS weights": lpips,
        "learned features": learned,
        **{name: partial(extra, name) for name in EXTRAS},
    }
    return [_guarded(name, check) for name, check in checks.items()]


def run(console: Console) -> int:
    """Print the report and return the exit code: 0 if training is possible on this machine, else
    1."""
    checks = diagnose()
    console.print(render(checks), markup=False, soft_wrap=True)
    return exit_code(checks)


def exit_code(checks: list[Check]) -> int:
    """0 if everything that training requires is there, else 1."""
    return 0 if all(check.ok for check in checks if check.needed) else 1


def render(checks: list[Check]) -> str:
    """The report as plain text: a line per check, with advice below it if something is missing, and
    a conclusion."""
    width = max(len(check.name) for check in checks)
    lines = []
    for check in checks:
        mark = "ok" if check.ok else "MISSING" if check.needed else "optional"
        lines.append(f"{mark:<10}{check.name:<{width}}  {check.found}")
        if check.fix and not check.ok:
            lines.append(f"{'':<10}{'':<{width}}  -> {check.fix}")
    return "\n".join([*lines, "", verdict(checks)])


def verdict(checks: list[Check]) -> str:
    """One sentence: the backend that a training would use."""
    if exit_code(checks):
        return "Training is not possible yet: fix what is MISSING above."
    by_name = {check.name: check for check in checks}
    if by_name["CUDA"].ok and by_name["gsplat"].ok:
        return "Ready: training runs on CUDA through gsplat."
    if by_name["CPU library"].ok:
        return "Ready: training runs on the CPU with the compiled library."
    return "Ready, but slow: training runs in plain PyTorch, tens of times slower than with the compiled CPU library."


def python() -> Check:
    found = f"{platform.python_version()} ({platform.system()} {platform.machine()})"
    return Check("Python", sys.version_info >= (3, 11), found, "install Python 3.11 or newer", needed=True)


def pytorch() -> Check:
    numbers = [int("".join(filter(str.isdigit, part)) or 0) for part in torch.__version__.split("+")[0].split(".")[:2]]
    fix = f"install torch 2.7 or newer; {PIN}"
    return Check("torch", tuple(numbers) >= (2, 7), f"{torch.__version__}, CPU {torch.backends.cpu.get_cpu_capability()}", fix, needed=True)


def cuda() -> Check:
    if torch.version.hip is not None:
        return Check("CUDA", False, f"this torch is built for AMD's ROCm {torch.version.hip}, where no kernel here runs: the CPU is used")
    if torch.cuda.is_available():
        names = [torch.cuda.get_device_properties(i) for i in range(torch.cuda.device_count())]
        return Check("CUDA", True, "; ".join(f"{p.name}, {p.total_memory / 2**30:.0f} GiB" for p in names))
    if torch.version.cuda is None:
        fix = f"only for an NVIDIA GPU: install a CUDA build of torch {torch.__version__.split('+')[0]}"
        return Check("CUDA", False, "this build of torch does not support it", fix)
    found = f"torch supports CUDA {torch.version.cuda}, but finds no device"
    return Check("CUDA", False, found, "check the NVIDIA driver with nvidia-smi")


def native_library() -> Check:
    reason = native.explain_missing()
    if reason is None:
        return Check("CPU library", True, f"{native.load().level}, up to {native.count_threads()} threads")  # type: ignore[union-attr]
    why, _, fix = reason.partition(": ")
    return Check("CPU library", False, f"{why}; the slow PyTorch reference is used instead", fix)


def gsplat() -> Check:
    version = _version("gsplat")
    if version is None:
        if not torch.cuda.is_available():
            return Check("gsplat", False, "not installed (it only runs on CUDA)")
        return Check("gsplat", False, "not installed", f"{install_line('cuda')} for training on this GPU; {PIN}")
    if not torch.cuda.is_available():
        return Check("gsplat", False, f"{version} is installed, but it needs a CUDA device", "use the CPU library: --rasterizer cpu")
    try:
        from scene_experts.render import gsplat_install

        gsplat_install.try_again()
        reason = gsplat_install.explain_missing()
    except Exception as error:  # a broken compiled extension may raise anything when imported
        reason = f"{type(error).__name__}: {error}"
    why, _, fix = (reason or "").rpartition(": ")
    return Check("gsplat", reason is None, version if reason is None else f"{version}: {why}", fix)


def triton() -> Check:
    version = _version("triton")
    if not torch.cuda.is_available():
        return Check("triton", False, f"{version or 'not installed'} (it only runs on CUDA)")
    from scene_experts.native.triton import explain_missing

    reason = explain_missing()
    why, _, fix = (reason or "").partition(": ")
    return Check("triton", reason is None, version or "unknown" if reason is None else f"{why}; anchors are decoded in plain PyTorch", fix)


def machine() -> Check:
    usable = native.count_cores()
    threads = torch.get_num_threads()
    fix = f"set OMP_NUM_THREADS to {usable} at most: more threads than cores slow training down"
    return Check("cores", threads <= usable, f"{usable} usable of {os.cpu_count()}, torch uses {threads} threads", fix)


def memory() -> Check:
    free = available_bytes()
    if free is None:
        return Check("memory", True, "unknown")
    fix = "less than 2 GiB is free: train at a lower --resolution, or limit densification with --max-memory"
    return Check("memory", free >= 2 * 2**30, f"{free / 2**30:.1f} GiB free", fix)


def lpips() -> Check:
    from scene_experts.evaluate import weights

    reasons = {}
    for net in ("vgg", "alex"):
        try:
            weights.load(net)
        except (weights.MissingWeights, InputError) as error:
            reasons[net] = str(error)
    if not reasons:
        return Check("LPIPS weights", True, f"found for VGG and AlexNet (kept in {weights.cache_dir()})")
    why = "; ".join(reason.removesuffix(f": {weights.HOW}") for reason in reasons.values())
    return Check("LPIPS weights", False, f"{why}; scores are written without them", weights.HOW)


def learned() -> Check:
    from scene_experts.sfm.learned.weights import INSTALL, find_weights

    folder = find_weights()
    what = "weights of ALIKED and LightGlue, for photographs that COLMAP's features do not connect (capture)"
    return Check("learned features", folder is not None, f"{what}: {folder or 'not installed'}", f"run `{INSTALL}`")


def extra(name: str) -> Check:
    """Check an optional package without importing it: pycolmap corrupts the heap of a process that
    also uses Pillow."""
    module, purpose = EXTRAS[name]
    version = _version(module)
    if version is not None:
        return Check(name, True, f"{module} {version}: {purpose}")
    return Check(name, False, f"{module} is not installed: {purpose}", install_line(name))


def _version(name: str) -> str | None:
    if importlib.util.find_spec(name) is None:
        return None
    try:
        return importlib.metadata.version(importlib.metadata.packages_distributions().get(name, [name])[0])
    except importlib.metadata.PackageNotFoundError:
        return "version unknown"


def _guarded(name: str, check: Callable[[], Check]) -> Check:
    try:
        return check()
    except Exception as error:  # the report must appear whatever is broken
        needed = name in ("Python", "torch")
        return Check(name, False, f"the check itself failed: {type(error).__name__}: {error}", "report this", needed)
