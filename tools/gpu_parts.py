"""Make beforehand, on a machine without a GPU, what takes long to build on one: `make gpu-parts PY=PYTHON DATA=CAPTURE`.

    PYTHON tools/gpu_parts.py --data CAPTURE --out .gpu

PYTHON is like that of the GPU machine: the same release of Python, torch for CUDA and Triton, and pytest. CUDA's toolkit of torch's release
(nvcc; CUDA_HOME) and gcc are needed. The folder gets, below 64 MiB in all: site (gsplat, compiled for --arch, with the functions that this
project calls), triton.tar.xz (Triton's cache with every kernel of the stages of tools/gpu.py, found by rehearsing them on a pretended
device), native (the compiled library of `make env`), capture (a copy) and parts.json. What is there is kept; --only makes a part anew.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import time
import zipfile
from pathlib import Path

import gpu

ROOT = gpu.ROOT
WORK = ROOT / "build" / "gpu-parts"
GSPLAT = "1.5.3"
MOST = 64 << 20  # bytes that travel to a GPU machine
CHANNELS = ("3", "4")  # that are rasterised: colours, of plain gsplat; colours and depth
CALLED = (
    *("spherical_harmonics_fwd", "spherical_harmonics_bwd", "intersect_tile", "intersect_offset"),
    *("projection_ewa_3dgs_fused_fwd", "projection_ewa_3dgs_fused_bwd", "rasterize_to_pixels_3dgs_fwd", "rasterize_to_pixels_3dgs_bwd"),
)
SOURCES = (
    *("RasterizeToPixels3DGSBwd.cu", "RasterizeToPixels3DGSFwd.cu", "ProjectionEWA3DGSFused.cu", "SphericalHarmonicsCUDA.cu"),
    *("IntersectTile.cu", "Rasterization.cpp", "Projection.cpp", "SphericalHarmonics.cpp", "Intersect.cpp"),
)
BINDINGS = """#include <torch/extension.h>

#include "Cameras.h"
#include "Ops.h"

PYBIND11_MODULE(TORCH_EXTENSION_NAME, m) {
  py::enum_<gsplat::CameraModelType>(m, "CameraModelType")
      .value("PINHOLE", gsplat::CameraModelType::PINHOLE)
      .value("ORTHO", gsplat::CameraModelType::ORTHO)
      .value("FISHEYE", gsplat::CameraModelType::FISHEYE)
      .value("FTHETA", gsplat::CameraModelType::FTHETA)
      .export_values();
  %s
}
"""


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="the capture that is copied")
    parser.add_argument("--out", type=Path, default=gpu.PARTS)
    parser.add_argument("--arch", default="90", help="compute capability of the GPU, without a dot")
    parser.add_argument("--only", nargs="+", choices=("gsplat", "native", "capture", "triton"), help="make these anew")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = make_parser().parse_args(argv)
    out: Path = args.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    parts = {
        "gsplat": (out / "site", lambda: build_gsplat(out / "site", args.arch)),
        "native": (out / "native", lambda: copy_native(out / "native")),
        "capture": (out / "capture", lambda: shutil.copytree(args.data, out / "capture")),
        "triton": (out / "triton.tar.xz", lambda: compile_kernels(out)),
    }
    for name, (place, make) in parts.items():
        if name in (args.only or ()) and place.is_dir():
            shutil.rmtree(place)
        if name in (args.only or ()) or not place.exists():
            began = time.monotonic()
            make()
            print(f"{name}: {measure(place) / 2**20:.1f} MiB, {time.monotonic() - began:.0f} s", flush=True)
    (out / "parts.json").write_text(json.dumps(gpu.list_versions() | {"gsplat": GSPLAT, "arch": args.arch}, indent=1))
    check_size(out)
    return 0


def measure(place: Path) -> int:
    """Bytes of a file or folder."""
    return sum(path.stat().st_size for path in (place, *place.rglob("*")) if path.is_file())


def check_size(out: Path) -> None:
    """Raises SystemExit if the parts are too large to travel."""
    sizes = {path.name: measure(path) for path in sorted(out.iterdir())}
    if sum(sizes.values()) >= MOST:
        found = ", ".join(f"{name} {size / 2**20:.0f}" for name, size in sizes.items() if size > 2**20)
        raise SystemExit(
            f"expected parts below {MOST >> 20} MiB, found {sum(sizes.values()) / 2**20:.0f} ({found}); give a smaller capture"
        )
    print(f"{out}: {sum(sizes.values()) / 2**20:.1f} MiB in all")


def copy_native(to: Path) -> None:
    """Copy the compiled library, one file for each instruction set."""
    found = sorted(ROOT.glob("build/py3-none-linux_*/se_*.so"))
    if not found:
        raise SystemExit("expected the compiled library in build, found none; run `make env` first")
    to.mkdir(parents=True)
    for path in found:
        shutil.copy2(path, to)


def restrict(text: str) -> str:
    """gsplat instantiates its rasteriser for 19 numbers of channels: keep the lines of those that are used. Most of the time to compile."""

    def kept(line: str) -> bool:
        found = re.fullmatch(r"\s*(?:__INS__|__LAUNCH_KERNEL__)\((\d+)\)\s*", line)
        return found is None or found.group(1) in CHANNELS

    return "\n".join(line for line in text.split("\n") if kept(line))


def build_gsplat(site: Path, arch: str) -> None:
    """Compile gsplat's sources from its wheel for the running Python, and make a package that needs no compiler."""
    import torch

    toolkit, version = Path(os.environ.get("CUDA_HOME", "/usr/local/cuda")), torch.version.cuda
    if version is None or not (toolkit / "bin" / "nvcc").is_file():
        raise SystemExit(f"expected torch for CUDA and its toolkit, found torch {torch.__version__} and {toolkit}; set CUDA_HOME")
    download, sources, objects = WORK / "download", WORK / "gsplat", WORK / "objects"
    if not list(download.glob("gsplat-*.whl")):
        subprocess.run([sys.executable, "-m", "pip", "download", "-q", "--no-deps", "-d", str(download), f"gsplat=={GSPLAT}"], check=True)
    shutil.rmtree(sources, ignore_errors=True)
    with zipfile.ZipFile(next(download.glob("gsplat-*.whl"))) as wheel:
        wheel.extractall(sources)
    cuda = sources / "gsplat" / "cuda"
    for name in ("RasterizeToPixels3DGSFwd.cu", "RasterizeToPixels3DGSBwd.cu", "Rasterization.cpp"):
        path = cuda / "csrc" / name
        path.write_text(restrict(path.read_text()))
    (cuda / "csrc" / "bindings.cpp").write_text(BINDINGS % "\n  ".join(f'm.def("{name}", &gsplat::{name});' for name in CALLED))
    where = Path(torch.__file__).parent
    standard = "c++17" if tuple(int(n) for n in torch.__version__.split(".")[:2]) < (2, 12) else "c++20"
    places = (cuda / "include", cuda / "csrc" / "third_party" / "glm")
    systems = (where / "include", where / "include/torch/csrc/api/include", toolkit / "include", toolkit / "include/cccl")
    common = ["-DTORCH_EXTENSION_NAME=csrc", "-DTORCH_API_INCLUDE_EXTENSION_H", f"-std={standard}", "-O3"]
    common += [f"-I{place}" for place in places]
    common += [word for place in (*systems, sysconfig.get_path("include")) for word in ("-isystem", str(place))]
    # What is not called goes with its missing kernels: symbols are hidden, and sections collected.
    host = ["-fPIC", "-fvisibility=hidden", "-fvisibility-inlines-hidden", "-ffunction-sections", "-fdata-sections"]
    device = ["--expt-relaxed-constexpr", f"-gencode=arch=compute_{arch},code=sm_{arch}", "-use_fast_math"]
    device += [f"-D__CUDA_NO_{name}__" for name in ("HALF_OPERATORS", "HALF_CONVERSIONS", "BFLOAT16_CONVERSIONS", "HALF2_OPERATORS")]
    device += ["--compiler-options", ",".join(host)]
    objects.mkdir(parents=True, exist_ok=True)
    key = f"{arch}-{sys.version_info.major}.{sys.version_info.minor}-{torch.__version__}"
    made = []
    for name in (*SOURCES, "bindings.cpp"):
        source, target = cuda / "csrc" / name, objects / f"{name}-{key}.o"
        made.append(target)
        if target.is_file():  # of a call that was stopped
            continue
        compiler = [str(toolkit / "bin" / "nvcc"), *device] if name.endswith(".cu") else ["g++", "-Wno-attributes", *host]
        print(f"  {name}", flush=True)
        unfinished = target.with_suffix(".unfinished.o")
        subprocess.run([*compiler, *common, "-c", str(source), "-o", str(unfinished)], check=True)
        unfinished.replace(target)
    for path in (sources / "gsplat").rglob("*.py"):
        to = site / path.relative_to(sources)
        to.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(path, to)
    shutil.copytree(next(sources.glob("gsplat-*.dist-info")), site / f"gsplat-{GSPLAT}.dist-info")
    library = site / "gsplat" / f"csrc{sysconfig.get_config_var('EXT_SUFFIX')}"
    names = ("c10", "c10_cuda", "torch_cpu", "torch_cuda", "torch", "torch_python")
    links = [f"-L{where / 'lib'}", *(f"-l{name}" for name in names), f"-L{toolkit / 'lib64'}", "-lcudart"]
    subprocess.run(["g++", "-shared", "-o", str(library), *map(str, made), "-Wl,--gc-sections", "-Wl,-s", *links], check=True)


def compile_kernels(out: Path) -> None:
    """Rehearse the stages on a pretended device with an empty cache, and pack what Triton compiled: the GPU machine finds the same keys."""
    cache = WORK / "triton"
    shutil.rmtree(cache, ignore_errors=True)
    environment = os.environ | {"TRITON_CACHE_DIR": str(cache), "TRITON_STORE_BINARY_ONLY": "1"}
    begin = [sys.executable, "benchmarks/pretended_cuda/start.py"]
    tests = [*begin, "-m", "pytest", "-q", "-m", "not slow", "-p", "no:cacheprovider", "--tb=no", *gpu.TESTS]
    paths = os.pathsep.join([str(out / "site"), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        tests, cwd=ROOT, env=environment | {"SCENE_EXPERTS_GPU": "1", "PYTHONPATH": paths}, capture_output=True, text=True
    )
    print(f"  tests, whose numbers cannot be right: {(done.stdout.splitlines() or ['no output'])[-1]}", flush=True)
    stages = ["--stages", "kernels", "decode", "steps", "eval", "train", "--tiny", "--seconds", "3000"]
    rehearsal = ["tools/gpu.py", "--data", str(out / "capture"), "--parts", str(out), "--out", str(WORK / f"rehearsal-{os.getpid()}")]
    subprocess.run([*begin, *rehearsal, *stages], cwd=ROOT, env=environment, check=True)
    kernels = list(cache.glob("*/*.cubin"))
    if not kernels:
        raise SystemExit("expected kernels in Triton's cache, found none; the output above says why")
    print(f"  {len(kernels)} kernels", flush=True)
    unfinished = out / "triton.unfinished"
    with tarfile.open(unfinished, "w:xz") as archive:
        for folder in sorted(cache.iterdir()):
            archive.add(folder, folder.name)
    unfinished.replace(out / "triton.tar.xz")


if __name__ == "__main__":
    raise SystemExit(main())
