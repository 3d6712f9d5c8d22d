"""Build the compiled library with the address and undefined-behaviour sanitisers and run the tests of native code on it.

    python tools/sanitize.py                  every instruction set of this processor
    python tools/sanitize.py avx2 portable    some of them
    python tools/sanitize.py avx2 -- -k adam  further arguments of pytest

The first report of a sanitiser ends the tests with its stack. Needs cmake and g++ on Linux. Torch itself is not instrumented, so leaks are
not looked for.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BUILD = ROOT / "build" / "sanitize"
LEVELS = {"avx512": "avx512", "avx2": "avx2", "portable": "default"}  # the name that torch has for each
TESTS = (
    "tests/unit/native",
    "tests/unit/render/test_cpu.py",
    "tests/unit/training/test_optim.py",
    "tests/unit/training/test_photometric.py",
    "tests/unit/training/test_losses.py",
    "tests/unit/scene/anchors/test_native_decode.py",
    "tests/unit/scene/graph",
    "tests/unit/geometry/test_sh_colors.py",
    "tests/unit/strategy/test_mcmc.py",
)
RUN = """
import sys, scene_experts
scene_experts.__path__.insert(0, {build!r})
from scene_experts.native import library
found = library.load()
assert found and found.level == {level!r} and found._name.startswith({build!r}), found
import pytest
sys.exit(pytest.main({arguments!r}))
"""


def build() -> None:
    """Build every instruction set. Only what changed is compiled again."""
    options = ["-DSCENE_EXPERTS_SANITIZE=ON", f"-DCMAKE_LIBRARY_OUTPUT_DIRECTORY={BUILD / '_native'}"]
    subprocess.run(["cmake", "-S", str(ROOT), "-B", str(BUILD), *options], check=True, stdout=subprocess.DEVNULL)
    subprocess.run(["cmake", "--build", str(BUILD), "-j", str(os.cpu_count())], check=True, stdout=subprocess.DEVNULL)


def test(level: str, more: list[str]) -> int:
    """Run the tests on one instruction set and return the exit code."""
    runtime = [subprocess.check_output(["g++", f"-print-file-name=lib{name}.so"], text=True).strip() for name in ("asan", "ubsan")]
    environment = {
        **os.environ,
        "LD_PRELOAD": " ".join(runtime),
        "ASAN_OPTIONS": "detect_leaks=0:abort_on_error=1:allocator_may_return_null=1",
        "UBSAN_OPTIONS": "print_stacktrace=1",
        "ATEN_CPU_CAPABILITY": LEVELS[level],
    }
    arguments = ["-q", "-x", "-p", "no:cacheprovider", "-m", "not slow", *TESTS, *more]
    code = RUN.format(build=str(BUILD), level=level, arguments=arguments)
    return subprocess.run([sys.executable, "-c", code], env=environment, cwd=ROOT, check=False).returncode


def main(words: list[str]) -> int:
    chosen, more = words, []
    if "--" in words:
        chosen, more = words[: words.index("--")], words[words.index("--") + 1 :]
    build()
    from scene_experts.native.library import list_levels

    for level in chosen or list_levels():
        print(f"{level}:", flush=True)
        if code := test(level, more):
            print(f"{level}: failed ({code})")
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
