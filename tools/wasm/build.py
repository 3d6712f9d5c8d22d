"""Compile the reading half of csrc/code*.cpp to WebAssembly, for the reader in JavaScript.

    pip install ziglang==0.17.1
    python tools/wasm/build.py

Writes integrations/javascript/codec.mjs: the module, deflated, in base64, below a checksum of its
sources, by which a test sees whether it is that of the sources. Then build the pages that hold it:
cd tools/viewer && npm install && npm run build.
"""

from __future__ import annotations

import base64
import hashlib
import re
import subprocess
import sys
import tempfile
import zlib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FILE = ROOT / "integrations" / "javascript" / "codec.mjs"
COMPILED = [ROOT / "csrc" / f"code{part}.cpp" for part in ("", "_cells", "_context", "_read")] + [Path(__file__).with_name("memory.cpp")]
SOURCES = [*COMPILED, ROOT / "csrc" / "code.h", ROOT / "csrc" / "status.h", Path(__file__)]
INTERFACE, OURS = ROOT / "csrc" / "se_api.h", "// ---- Entropy coder"
EXPORTS = ("take", "release", *(f"se_code_{name}" for name in ("read", "read_bits", "read_cells", "predict", "inputs", "blend")))
TARGET = ("-target", "wasm32-wasi", "-mexec-model=reactor", "-msimd128", "-mbulk-memory")
OPTIONS = (
    "-O3",
    "-std=c++20",
    "-fno-exceptions",
    "-fno-rtti",
    "-fno-threadsafe-statics",
    "-fvisibility=hidden",
    "-Wl,--strip-all",
    "-Wl,-z,stack-size=524288",
)


def checksum() -> str:
    """The SHA-256 of the sources, this one too, and of the coder's part of the C interface."""
    texts = [path.read_text("utf-8") for path in SOURCES]
    interface = INTERFACE.read_text("utf-8")
    return hashlib.sha256("".join([*texts, interface[interface.index(OURS) :]]).encode()).hexdigest()


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "codec.wasm"
        exports = [f"-Wl,--export={name}" for name in EXPORTS]
        stops = "-D_LIBCPP_VERBOSE_ABORT(...)=__builtin_trap()"  # in place of a message, which would need a system
        command = [sys.executable, "-m", "ziglang", "c++", *TARGET, *OPTIONS, stops, *exports, "-o", str(out), *map(str, COMPILED)]
        subprocess.run(command, check=True, cwd=ROOT / "csrc")
        module = out.read_bytes()
    text = re.sub("(.{1,138})", r"\1\\\n", base64.b64encode(zlib.compress(module, 9)).decode())
    head = "// csrc/code*.cpp as WebAssembly, deflated, in base64, made by tools/wasm/build.py; compiled.mjs runs it."
    FILE.write_text(f"{head}\n// {checksum()}\nexport default `\\\n{text}`;\n")
    print(f"{FILE.relative_to(ROOT)}: {len(module):,} bytes, in the file {FILE.stat().st_size:,}")


if __name__ == "__main__":
    main()
