"""Build the sdist and, from it, wheels for other systems, and check each of them. Nothing but Python is needed: zig compiles.

Usage: python tools/wheels.py [--out DIST] [TARGET ...]    without targets: all of `TARGETS`

`make wheels` runs it in an environment of its own (`REQUIREMENTS`). The wheels are built from the unpacked sdist, outside of any git
checkout. A wheel for Linux must pass `auditwheel show`; of every wheel, each library must be one for the system and processor of its tag.
Releases are built by cibuildwheel on machines of each system (.github/workflows/wheels.yml); this script shows on one Linux machine
that the sources compile for all of them.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
REQUIREMENTS = ("build", "ziglang", "auditwheel", "wheel", "scikit-build-core", "cmake", "ninja")
EXPORTED = b"se_abi_version"  # a name that every library exports
GLIBC = 28  # oldest C library of Linux, 2.28: RHEL 8, Debian 10, Ubuntu 20.04
X86, ARM = ("avx512", "avx2", "portable"), ("portable",)  # instruction sets, as native/library.py names them


@dataclass(frozen=True)
class Target:
    """A system and processor to compile for."""

    triple: str
    """As zig names it, with the oldest C library."""
    system: str
    """CMake's name of the system."""
    processor: str
    tag: str
    """Platform tag of the wheel."""
    levels: tuple[str, ...]
    """Instruction sets that the wheel must hold a library for."""
    suffix: str
    """How file names of shared libraries end."""
    magic: bytes
    """First bytes of a library."""
    machine: tuple[int, bytes]
    """Where a library names its processor, and how. For Windows the place is counted from its PE header."""


ELF, MACH, DOS = b"\x7fELF\x02", b"\xcf\xfa\xed\xfe", b"MZ"
TARGETS = {
    "linux-x86_64": Target("x86_64-linux-gnu.2.28", "Linux", "x86_64", "manylinux_2_28_x86_64", X86, ".so", ELF, (18, b"\x3e\x00")),
    "linux-aarch64": Target("aarch64-linux-gnu.2.28", "Linux", "aarch64", "manylinux_2_28_aarch64", ARM, ".so", ELF, (18, b"\xb7\x00")),
    "macos-arm64": Target("aarch64-macos.11.0", "Darwin", "arm64", "macosx_11_0_arm64", ARM, ".dylib", MACH, (4, b"\x0c\x00\x00\x01")),
    "windows-x86_64": Target("x86_64-windows-gnu", "Windows", "AMD64", "win_amd64", X86, ".dll", DOS, (4, b"\x64\x86")),
}


def run(*command: str | Path, cwd: Path = ROOT, **env: str) -> str:
    """Run a command and return what it printed. Exits with its output where it fails."""
    done = subprocess.run([str(word) for word in command], cwd=cwd, env=os.environ | env, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{done.stdout}{done.stderr}\n`{' '.join(map(str, command))}` failed (see above)")
    return done.stdout


def write_toolchain(target: Target, folder: Path) -> Path:
    """Write a CMake toolchain file, and the compiler that it names, into `folder`; return its path."""
    tools = {"c++": f"c++ -target {target.triple}", "rc": "rc"}
    for name, words in tools.items():
        path = folder / name
        path.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m ziglang {words} "$@"\n')
        path.chmod(0o755)
    lines = [
        f"set(CMAKE_SYSTEM_NAME {target.system})",
        f"set(CMAKE_SYSTEM_PROCESSOR {target.processor})",
        f"set(CMAKE_CXX_COMPILER {folder / 'c++'})",
        f"set(CMAKE_RC_COMPILER {folder / 'rc'})",  # CMake looks for one on Windows; no file needs it
        f"set(CMAKE_INSTALL_NAME_TOOL {folder / 'nothing'})",  # and for this on macOS; names need no change
        'set(CMAKE_OSX_SYSROOT "")',
        "set(CMAKE_SHARED_LINKER_FLAGS_INIT -s)" if target.system != "Darwin" else "",
    ]
    (folder / "nothing").write_text("#!/bin/sh\n")
    (folder / "nothing").chmod(0o755)
    path = folder / "toolchain.cmake"
    path.write_text("\n".join(lines) + "\n")
    return path


def make_sdist(out: Path) -> Path:
    """The path of the source archive, built into `out`."""
    printed = run(sys.executable, "-m", "build", "--sdist", "--no-isolation", "--outdir", out, ROOT)
    found = re.findall(r"Successfully built (\S+\.tar\.gz)", re.sub(r"\x1b\[[0-9;]*m", "", printed))
    return out / found[-1]


def make_wheel(sdist: Path, target: Target, out: Path) -> Path:
    """Build a wheel for a target from the source archive; return its path in `out`."""
    with tempfile.TemporaryDirectory() as temporary:
        work = Path(temporary)
        with tarfile.open(sdist) as archive:
            archive.extractall(work, filter="data")
        source, built = work / sdist.name.removesuffix(".tar.gz"), work / "built"
        toolchain = write_toolchain(target, work)
        run(
            *(sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", built, source),
            cwd=work,
            CMAKE_TOOLCHAIN_FILE=str(toolchain),
        )
        (wheel,) = built.glob("*.whl")
        run(sys.executable, "-m", "wheel", "tags", "--remove", "--platform-tag", target.tag, wheel, cwd=built)
        (wheel,) = built.glob("*.whl")
        return Path(wheel.rename(out / wheel.name))


def check(wheel: Path, target: Target) -> str:
    """What the wheel holds, in one line. Exits where it does not fit its tag."""
    wanted = {f"scene_experts/_native/se_{level}{target.suffix}" for level in target.levels}
    with zipfile.ZipFile(wheel) as archive:
        found = {name for name in archive.namelist() if "/_native/" in name and name.endswith(target.suffix)}
        if found != wanted:
            sys.exit(f"expected the libraries {sorted(wanted)} in {wheel.name}, found {sorted(found)}")
        for name in sorted(found):
            data = archive.read(name)
            place, code = target.machine
            if target.magic == DOS:
                place += int.from_bytes(data[60:64], "little")
            if not data.startswith(target.magic) or data[place : place + len(code)] != code or EXPORTED not in data:
                sys.exit(f"expected a library for {target.tag} in {name} of {wheel.name}, found another")
    said = f"{wheel.name}: {wheel.stat().st_size / 1e6:.2f} MB, {len(found)} libraries"
    if target.system == "Linux":
        printed = " ".join(run(sys.executable, "-m", "auditwheel", "show", wheel).split())
        tag = re.search(r'consistent with the following platform tag: "(manylinux_2_(\d+)_\w+)"', printed)
        if tag is None or int(tag[2]) > GLIBC:
            sys.exit(f"expected a wheel that fits {target.tag}, found this of auditwheel: {printed}")
        said += f", auditwheel: {tag[1]}"
    return said


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=f"among {', '.join(TARGETS)}; all of them by default")
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="folder for the sdist and the wheels")
    parser.add_argument("--requirements", action="store_true", help="print the packages that this script needs")
    args = parser.parse_args()
    if args.requirements:
        print(" ".join(REQUIREMENTS))
        return
    unknown = set(args.targets) - set(TARGETS)
    if unknown:
        parser.error(f"expected targets among {', '.join(TARGETS)}, found {', '.join(sorted(unknown))}")
    args.out = args.out.absolute()
    args.out.mkdir(parents=True, exist_ok=True)
    sdist = make_sdist(args.out)
    print(f"{sdist.name}: {sdist.stat().st_size / 1e6:.2f} MB", flush=True)
    for name in args.targets or TARGETS:
        print(check(make_wheel(sdist, TARGETS[name], args.out), TARGETS[name]), flush=True)


if __name__ == "__main__":
    main()
