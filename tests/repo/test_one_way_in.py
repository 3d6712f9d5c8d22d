"""No module opens a foreign file by itself: files that others wrote are read through `core/reading`, within a budget."""

import ast
from pathlib import Path

import pytest

import scene_experts

SOURCE = Path(scene_experts.__file__).parent
READING = SOURCE / "core" / "reading"
NAMES = {  # functions that open or decode what a file holds
    "open", "read_bytes", "read_text", "fromfile", "memmap", "load", "loads", "safe_open", "load_file", "ZipFile", "is_zipfile",
    "Unpickler", "decompress", "GzipFile", "genfromtxt", "loadtxt",
}  # fmt: skip
OWNERS = {"json", "np", "torch", "pickle", "zipfile", "tarfile", "gzip", "Image", "yaml", "safetensors", "tomllib", "io"}
ALLOWED = {  # file: why it may open files by itself
    "bench/cloud.py": "a benchmark's own point cloud, named on the command line by its developer",
    "bench/machine.py": "/proc",
    "core/io.py": "writes",
    "core/reading/exr.py": "a temporary copy of the bytes that `pictures.opening_picture` guards",
    "data/fetch/archive.py": "archives that are downloaded: docs/security.md, downloads",
    "data/fetch/download.py": "downloads: docs/security.md",
    "data/store.py": "/proc and /sys",
    "evaluate/tables.py": "a file of this package",
    "evaluate/weights.py": "files with a published SHA-256, which is verified first",
    "files/export.py": "the run's own list of cameras, copied",
    "files/formats/html.py": "files of this package",
    "files/formats/usd.py": "arrays of its own worker",
    "files/formats/usd_worker.py": "arrays of the process that started it; usd-core reads the file: docs/formats.md",
    "report/page.py": "a file of this package",
    "reproduce/cluster.py": "a run from the user's own Dask scheduler, which sends pickled code itself: docs/scaling.md",
    "reproduce/figures.py": "pictures of the user's own records",
    "reproduce/plan.py": "source files of installed packages, whose hash is part of a run's name",
    "reproduce/report.py": "a table that it has just written",
    "reproduce/runner.py": "logs of its own processes",
    "sfm/frames.py": "the pipe of ffmpeg",
    "sfm/masks.py": "the masks that it has just written",
    "sfm/colmap.py": "messages and the log of its own process",
    "sfm/reconstruct.py": "notes of earlier calls",
    "sfm/worker/__main__.py": "a message of the process that started it",
    "sfm/worker/features.py": "the database that it has made",
    "sfm/worker/lenses.py": "the database that it has made",
    "sfm/worker/mappers.py": "the database that it has made",
    "sfm/worker/matches.py": "that database, and arrays of the process that started it",
    "sfm/worker/missing.py": "the database that it has made",
    "sfm/worker/rigs.py": "the database that it has made",
    "training/memory.py": "/proc",
    "training/record.py": "the metrics of the run itself",
}


def opened(path: Path) -> list[str]:
    """The calls in a module that open or decode files for reading."""
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if not isinstance(node, ast.Call):
            continue
        function = node.func
        name = function.attr if isinstance(function, ast.Attribute) else function.id if isinstance(function, ast.Name) else ""
        owner = function.value.id if isinstance(function, ast.Attribute) and isinstance(function.value, ast.Name) else ""
        constants = (a for a in [*node.args, *(k.value for k in node.keywords)] if isinstance(a, ast.Constant))
        modes = [a.value for a in constants if isinstance(a.value, str)]
        writes = name in ("open", "ZipFile") and any(mode[:1] in "wax" for mode in modes)
        generic = name in ("load", "loads", "decompress") and owner not in OWNERS  # a method of our own
        if name in NAMES and not writes and not generic:
            found.append(f"line {node.lineno}: {owner}.{name}")
    return found


@pytest.mark.parametrize("path", sorted(SOURCE.rglob("*.py")), ids=lambda p: str(p.relative_to(SOURCE)))
def test_files_are_opened_in_one_package(path):
    relative = path.relative_to(SOURCE).as_posix()
    if not path.is_relative_to(READING) and relative not in ALLOWED:
        assert not opened(path), f"{relative} reads a file by itself: use core/reading (opening, read_json, opening_picture, ...)"


def test_the_exceptions_exist():
    assert all((SOURCE / name).is_file() for name in ALLOWED)
