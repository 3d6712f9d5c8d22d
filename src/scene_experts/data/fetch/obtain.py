"""Downloads scenes of the catalog, verifies and unpacks them into one folder, and finds them there.

ROOT/archives/360_v2.zip             an archive as published, downloaded once for all its scenes
ROOT/archives/checksums.json         checksums of the first downloads, for comparison with later
ones ROOT/mipnerf360/bonsai/              a scene: images/, sparse/0/, and source.json, which states
its origin
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from scene_experts.core.errors import InputError, RunError
from scene_experts.core.io import cache_dir, read_json, write_json
from scene_experts.core.progress import Progress
from scene_experts.data.fetch.archive import extract
from scene_experts.data.fetch.catalog import PREFIX, CatalogScene, RemoteArchive, one
from scene_experts.data.fetch.download import Say, check_web_address, fetch, sha256

VARIABLE = "SCENE_EXPERTS_CAPTURES"


def captures_dir() -> Path:
    """Return the folder of downloaded scenes: $SCENE_EXPERTS_CAPTURES, or `captures` in the user's
    cache folder."""
    return Path(os.environ.get(VARIABLE) or cache_dir() / "captures")


def is_present(root: Path, scene: CatalogScene) -> bool:
    """Return whether the scene is in `root`, downloaded or copied there by hand."""
    return all((root / scene.path / name).is_dir() for name in ("images", "sparse"))


def resolve(path: Path, resolution: str, split: str) -> tuple[Path, str, str]:
    """Return the folder, resolution and split of a capture. A path `catalog:SCENE` is looked up,
    any other path is returned as it is.

    For a scene of the catalog, "auto" is replaced by the paper's protocol.
    Raises InputError for an unknown scene and for a scene that is not on this machine.
    """
    if not str(path).startswith(PREFIX):
        return path, resolution, split
    scene, root = one(str(path)), captures_dir()
    if not is_present(root, scene):
        raise InputError(
            f"expected the scene {scene.name} at {root / scene.path}, found none; download it with `scene-experts download {scene.name}`, "
            f"or set {VARIABLE} to the folder that was given as --to"
        )
    return root / scene.path, scene.resolution if resolution == "auto" else resolution, scene.split if split == "auto" else split


def obtain(
    scenes: Sequence[CatalogScene],
    root: Path,
    *,
    mirrors: Sequence[str] = (),
    keep: bool = True,
    say: Say = print,
    progress: Progress | None = None,
) -> None:
    """Download and unpack `scenes` into `root`. Scenes that are already there are not touched;
    shared archives are downloaded once.

    Args:
        mirrors: Addresses of folders (or of the archive itself) that are tried before the owner's
            address.
        keep: Keep the archives for other scenes.
        say: Called with each message.
        progress: Called with the name of the work, the bytes so far and in total.

    Raises:
        InputError: if a mirror is not a web address.
        RunError: if a download or an archive fails. What was completed before stays.
    """
    for mirror in mirrors:
        check_web_address(mirror)
    missing = [scene for scene in scenes if not is_present(root, scene)]
    for scene in scenes:
        if scene not in missing:
            say(f"{scene.name} is at {root / scene.path}")
    for archive in dict.fromkeys(scene.collection.archive for scene in missing):
        path, digest, url = _fetch_archive(archive, root, mirrors, say, progress)
        for scene in missing:
            if scene.collection.archive == archive:
                _unpack(scene, path, digest, root, say, progress)
                _write_record(root, archive, digest, url)  # only once it proved complete: later downloads are compared with it
        if not keep:
            path.unlink()


def _unpack(scene: CatalogScene, archive: Path, digest: str, root: Path, say: Say, progress: Progress | None) -> None:
    into = root / scene.path
    if into.exists():
        raise RunError(f"expected images and sparse in {into}, found a folder without them; move it away and run the command again")
    told = (lambda done, total: progress(f"unpacking {scene.name}", done, total)) if progress else None
    out = extract(archive, scene.name, into, scene.inside, told)
    collection = scene.collection
    write_json(
        into / "source.json",
        {
            "scene": scene.name,
            "data_set": collection.title,
            "by": collection.source,
            "licence": collection.licence,
            "page": collection.archive.page,
            "archive": collection.archive.name,
            "archive_sha256": digest,
            "inside": out.inside,
            "resolution": scene.resolution,
            "split": scene.split,
        },
    )
    photographs = sum(p.is_file() for p in (into / "images").iterdir())
    if scene.views is not None and photographs != scene.views:
        say(f"warning: expected {scene.views} photographs of {scene.name}, found {photographs}; the owner may have changed the archive")
    say(f"{scene.name}: {out.files} files, {out.bytes / 1e6:,.0f} MB at {into}")


def _fetch_archive(
    archive: RemoteArchive, root: Path, mirrors: Sequence[str], say: Say, progress: Progress | None
) -> tuple[Path, str, str]:
    """Return the archive's file, its SHA-256 and the address that it was downloaded from. Downloads
    it unless it is there."""
    path = root / "archives" / archive.name
    known = _read_record(root).get(archive.name, {})
    digest = archive.sha256 or known.get("sha256")
    if path.is_file():
        return path, _verify(archive, path, known, root, say), known.get("from", "")
    urls = [m if m.endswith(archive.name) else f"{m.rstrip('/')}/{archive.name}" for m in mirrors]
    told = (lambda done, total: progress(archive.name, done, total)) if progress else None
    got = fetch(
        [*urls, *archive.urls], path, digest, size=archive.bytes, progress=told, say=say, advice=_manual_advice(archive, path, root, known)
    )
    if not digest:
        say(f"{archive.name}: SHA-256 {got.sha256} (none is published, so later downloads are compared with this one)")
    return path, got.sha256, got.url


def _verify(archive: RemoteArchive, path: Path, known: dict, root: Path, say: Say) -> str:
    """Return the SHA-256 of an existing archive. Only a new or changed file is read; otherwise the
    recorded value is used."""
    about = path.stat()
    if known and known.get("bytes") == about.st_size and known.get("changed") == about.st_mtime_ns:
        return str(known["sha256"])
    found = sha256(path)
    digest = archive.sha256 or known.get("sha256")
    if digest and found != digest:
        raise RunError(
            f"expected SHA-256 {digest[:12]}... of {path}, found {found[:12]}...; remove the file and run the command again"
            + ("" if archive.sha256 else f" (or, if its owner published a new version, remove its entry in {_record_file(root)})")
        )
    say(f"using {path}")
    return found


def _manual_advice(archive: RemoteArchive, path: Path, root: Path, known: dict) -> str:
    """Return what a user can do if no address works."""
    text = f"download {archive.name} ({archive.size}) by hand from {archive.page} to {path}"
    if known and not archive.sha256:
        text += f"; if its owner published a new version, remove its entry in {_record_file(root)}"
    return text


def _record_file(root: Path) -> Path:
    return root / "archives" / "checksums.json"


def _read_record(root: Path) -> dict[str, dict]:
    file = _record_file(root)
    found = read_json(file, "record of checksums") if file.is_file() else {}
    if not isinstance(found, dict) or not all(isinstance(v, dict) and isinstance(v.get("sha256"), str) for v in found.values()):
        raise InputError(f"expected a record of checksums at {file}, found something else; remove it")
    return found


def _write_record(root: Path, archive: RemoteArchive, digest: str, url: str) -> None:
    about, known = (root / "archives" / archive.name).stat(), _read_record(root)
    entry = {"sha256": digest, "bytes": about.st_size, "changed": about.st_mtime_ns, "from": url}
    if {k: known.get(archive.name, {}).get(k) for k in entry} != entry:
        when = datetime.now(UTC).isoformat(timespec="seconds")
        write_json(_record_file(root), {**known, archive.name: {**entry, "when": when}})
