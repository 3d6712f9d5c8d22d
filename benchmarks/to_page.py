"""From photographs to a page: wall and CPU seconds of each stage of `make`, scores and bytes.

    python benchmarks/to_page.py PHOTOS... [--minutes 5] [--scores] [--python OTHER/bin/python] [--json FILE]

Each PHOTOS (a folder or a video) is made into a page in a new folder. CPU seconds are those of all
processes. --python repeats each with another checkout, in turn with this one: what else the machine
does meets both alike; one from before `make` runs `capture`, the training that its `info` proposes
and `export`. --scores holds out every 8th photograph, scores the run and, after the clock is
stopped, its page; a checkout from before `make` has a page that was baked, of which the run's scores
are an upper bound.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

ONE = """
import json, re, resource, subprocess, sys, time
from pathlib import Path

import scene_experts as se

def cpu():
    return sum(sum(resource.getrusage(who)[:2]) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))

photos, out, minutes, scores = json.loads(sys.argv[1])
marks, last = [], [None]

def progress(what, done, total):
    name = what.split(" (about")[0]
    if name != last[0]:
        last[0] = name
        marks.append((name, time.monotonic(), cpu()))

if not hasattr(se, "make"):
    def call(name, *words):
        marks.append((name, time.monotonic(), cpu()))
        done = subprocess.run([sys.executable, "-m", "scene_experts", *words], check=True, stdout=subprocess.PIPE, text=True)
        print(done.stdout, file=sys.stderr)
        return done.stdout

    capture, run, page, held = f"{out}/capture", f"{out}/run", f"{out}/scene.html", ["--split", "mod8" if scores else "none"]
    began = time.monotonic()
    Path(out).mkdir(parents=True)
    call("poses", "capture", photos, "--out", capture)
    proposed = re.search("scene-experts train [^#\\n]*", call("info", "info", "--data", capture)).group().split()[1:]
    flags = [word for word in proposed if not word.startswith(("--data=", "--out=", "--split="))]
    for name in ("--data", "--out", "--split"):
        if name in flags:
            del flags[flags.index(name) : flags.index(name) + 2]
    call("training", *flags, "--data", capture, "--out", run, "--preview-every", "0", *held)
    if scores:
        call("scores", "eval", run)
    call("page", "export", run, "--format", "html", "--out", page, "--no-measure")
    marks.append(("end", time.monotonic(), cpu()))
    stages = [(a[0], b[1] - a[1], b[2] - a[2]) for a, b in zip(marks, marks[1:])]
    found = Path(run, "results.json")
    found = json.loads(found.read_text()) if found.is_file() else None
    print(json.dumps({
        "stages": stages, "seconds": {}, "psnr": None, "bytes": Path(page).stat().st_size,
        "scores": found, "run": run, "training": flags,
    }))
    raise SystemExit

began = ("start", time.monotonic(), cpu())
made = se.make(photos, out, minutes=minutes, scores=scores, say=lambda line: print(line, file=sys.stderr), progress=progress)
ends = [began, *marks, ("end", time.monotonic(), cpu())]
stages = [(a[0], b[1] - a[1], b[2] - a[2]) for a, b in zip(ends, ends[1:])]
run = made.run / "results.json"
page = None
if scores:
    again = ["export", str(made.run), "--format", "html", "--out", f"{out}/measured.html"]
    told = subprocess.run([sys.executable, "-m", "scene_experts", *again], check=True, stdout=subprocess.PIPE, text=True).stdout
    page = float(re.search(r"this file ([0-9.]+) dB", told).group(1))
print(json.dumps({
    "stages": stages, "seconds": made.seconds, "psnr": made.psnr, "bytes": made.page.stat().st_size,
    "scores": json.loads(run.read_text()) if scores and run.is_file() else None, "run": str(made.run),
    "page_psnr": page,
}))
"""


def make_page(python: str, photos: Path, minutes: float | None, scores: bool, folder: Path) -> dict[str, Any]:
    """Make a page with one interpreter in a new folder; returns what it measured."""
    asked = json.dumps([str(photos), str(folder), minutes, scores])
    done = subprocess.run([python, "-c", ONE, asked], check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def show(name: str, found: dict[str, Any]) -> None:
    """Print the table of one page."""
    scores = found["scores"] or {}
    told = [f"{key} {scores[key]:.3f}" for key in ("psnr", "lpips", "detail") if scores.get(key) is not None]
    told += [f"page {found['page_psnr']:.3f} dB"] if found.get("page_psnr") else []
    print(f"\n{name}: {found['bytes'] / 1e6:.2f} MB, {', '.join(told) or 'not scored'}")
    wall, cpu = (sum(stage[k] for stage in found["stages"]) for k in (1, 2))
    for stage, w, c in [*found["stages"], ("all", wall, cpu)]:
        print(f"  {stage[:48]:48} {w:8.1f} s wall {c:8.1f} s CPU")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", type=Path, nargs="+")
    parser.add_argument("--minutes", type=float)
    parser.add_argument("--scores", action="store_true")
    parser.add_argument("--python", action="append", default=[], help="the interpreter of another checkout")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows = []
    for photos in args.photos:
        for python in (sys.executable, *args.python):
            with tempfile.TemporaryDirectory() as folder:
                found = make_page(python, photos.resolve(), args.minutes, args.scores, Path(folder) / "scene")
            show(f"{photos.name} ({python})" if args.python else photos.name, found)
            rows.append({"photos": photos.name, "python": python, **found})
            if args.json:
                args.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
