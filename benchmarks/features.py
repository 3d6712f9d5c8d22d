"""Camera poses of every n-th photograph by COLMAP's features and by learned ones, beside those of all photographs.

    python benchmarks/features.py PHOTOS --every 2 --out OUT

Each row is `scene-experts capture` with one thread. "off" is the largest distance between a camera centre and that of the same photograph
in the reconstruction of all photographs, after a similarity transform, in percent of the largest distance of two of its centres. With
fewer than four poses the transform leaves nothing to compare.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import torch

from scene_experts.data.capture import load
from scene_experts.data.settings import Data
from scene_experts.sfm.photos import find_photos

KINDS = ("sift", "auto", "learned")


def make_capture(photos: Path, out: Path, features: str) -> float:
    """Make the capture and return the CPU seconds of the command."""
    words = ["capture", str(photos), "--out", str(out), "--features", features, "--threads", "1", "--overwrite"]
    process = subprocess.Popen([sys.executable, "-m", "scene_experts", *words], stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    return usage.ru_utime + usage.ru_stime if not process.returncode else float("nan")


def read_centres(capture: Path) -> dict[str, torch.Tensor]:
    """Return the camera centres [3] of a capture by photograph."""
    views = load(Data(capture, split="none", normalise="none"), 0).views
    return {view.name: view.camera.to(dtype=torch.float64).position for view in views}


def find_offsets(found: dict[str, torch.Tensor], known: dict[str, torch.Tensor]) -> torch.Tensor:
    """Return the distances of centres after a similarity transform (Umeyama 1991), relative to the largest of `known`."""
    names = sorted(found.keys() & known.keys())
    a, b = (torch.stack([centres[name] for name in names]) for centres in (found, known))
    whole = torch.stack(list(known.values()))
    source, target = a - a.mean(0), b - b.mean(0)
    u, s, vh = torch.linalg.svd(target.T @ source)
    sign = torch.tensor([1.0, 1.0, float(torch.det(u @ vh).sign())], dtype=a.dtype)
    scale = (s * sign).sum() / source.square().sum()
    return (scale * source @ (u @ torch.diag(sign) @ vh).T - target).norm(dim=1) / torch.cdist(whole, whole).max()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", type=Path, help="folder of photographs")
    parser.add_argument("--every", type=int, default=2, help="take every n-th photograph, the first of them the first")
    parser.add_argument("--out", type=Path, required=True, help="folder of the captures")
    asked = parser.parse_args()
    few = asked.out / f"every-{asked.every}"
    few.mkdir(parents=True, exist_ok=True)
    names = [photo.name for photo in find_photos(asked.photos)][:: asked.every]
    for name in names:
        shutil.copyfile(asked.photos / name, few / name)
    make_capture(asked.photos, asked.out / "all", "sift")
    known = read_centres(asked.out / "all")
    print(f"| features | poses of {len(names)} | by mapper | points | off, % | CPU s |\n|---|---|---|---|---|---|")
    for kind in KINDS:
        place = asked.out / f"{few.name}-{kind}"
        seconds = make_capture(few, place, kind)
        if seconds != seconds:
            print(f"| {kind} | 0 | - | - | - | - |", flush=True)
            continue
        note, centres = json.loads((place / "capture.json").read_text()), read_centres(place)
        off = f"{100 * float(find_offsets(centres, known).max()):.2f}" if len(centres) > 3 else "-"
        mappers = ", ".join(f"{count} {name}" for name, count in note["mappers"].items())
        print(
            f"| {note.get('features', 'SIFT')} ({kind}) | {len(centres)} | {mappers} | {note['points']} | {off} | {seconds:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
