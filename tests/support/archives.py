"""Archives that hold captures, and the files in a folder."""

from __future__ import annotations

import io
import tarfile
import zipfile
from pathlib import Path

FILES = {"images/b.jpg": b"b" * 1000, "images/a.jpg": b"a" * 10, "sparse/0/cameras.bin": b"c", "poses.npy": b""}


def write_zip(path: Path, files: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> Path:
    """Write `files` (bytes by name) as a ZIP archive."""
    with zipfile.ZipFile(path, "w", method) as out:
        for name, data in files.items():
            out.writestr(name, data)
    return path


def write_tar(path: Path, files: dict[str, bytes], links: dict[str, str] | None = None) -> Path:
    """Write `files` (bytes by name) and symbolic links (target by name) as a gzipped TAR archive."""
    with tarfile.open(path, "w:gz") as out:
        for name, data in files.items():
            info = tarfile.TarInfo(name)
            info.size = len(data)
            out.addfile(info, io.BytesIO(data))
        for name, target in (links or {}).items():
            info = tarfile.TarInfo(name)
            info.type, info.linkname = tarfile.SYMTYPE, target
            out.addfile(info)
    return path


def in_folder(prefix: str, files: dict[str, bytes] = FILES) -> dict[str, bytes]:
    """The same files with `prefix/` before their names."""
    return {f"{prefix}/{name}": data for name, data in files.items()}


def read_tree(folder: Path) -> dict[str, bytes]:
    """The bytes of every file below `folder`, by relative path."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
