"""Digests of what the program computes, to show that a redesign changes no bit.

Trains every recipe with `--deterministic` on a shipped capture in thumbnails (growth on both sides of a stop, then resumed), scores it,
exports it to every format, imports what can be imported, and records a SHA-256 of each result. Only the command line is used, so the same
script runs on any version of the project.

    python tools/digests.py RUNS --record digests.json         today's code; RUNS keeps the run folders
    python tools/digests.py RUNS2 --check digests.json         another version, on the same machine: exit code 1 and the places that differ
    python tools/digests.py RUNS --reopen digests.json         opens the run folders that another version wrote and scores them again
    python tools/digests.py RUNS2 --check digests.json --only moe-gs 3dgs         two recipes: training and pictures, no files
    python tools/digests.py RUNS2 --check digests.json --only "files of moe-gs"   the files of one recipe, and runs imported from them
    python tools/digests.py RUNS2 --check digests.json --only files --runs RUNS   the files of the runs in RUNS, without training

Digests belong to one machine and one build of torch: they are compared on the machine that recorded them. A file that holds the command
that wrote it is digested without the command, whose paths differ.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import json
import os
import re
import shutil
import sys
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"
ROOT = Path(__file__).resolve().parents[1]
CAPTURE = ROOT / "demo" / "buddha"
ITERATIONS, STOP = 40, 14
SHORT = ["--iterations", str(ITERATIONS), "--growth.adjust.interval", "4", "--deterministic", "--device", "cpu"]
READ = ["--data", str(CAPTURE), "--resolution", "longest:64", "--max-views", "12"]
FORMATS = ("compact", "anchors", "ply", "compressed-ply", "splat", "spz", "sog", "glb", "baked-html", "html")
FAMILIES = ("scaffold-gs", "moe-gs", "moe-gs-dist", "moe-gs-balance", "octree-moe-gs", "scaffold-gs-bank", "sags", "3dgs", "3dgs-mcmc")
APPEARANCE = ("moe-gs", "--scene.appearance", "8")


def run(*words: str) -> int:
    """Run a command of scene-experts in this process; its exit code. What it prints is not shown."""
    from scene_experts.cli import main

    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as errors:
        code = main(list(words))
    if code:
        sys.stderr.write(f"{' '.join(words)}: exit code {code}\n{errors.getvalue()}")
    return code


def sha(*parts: bytes) -> str:
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part)
    return digest.hexdigest()[:32]


def of_checkpoint(folder: Path) -> dict[str, str]:
    """Digest of every tensor of the newest checkpoint of a run."""
    from safetensors import safe_open

    newest = max((folder / "checkpoints").glob("ckpt_*.safetensors"))
    out = {}
    with safe_open(newest, framework="pt") as file:
        for name in sorted(file.keys()):
            tensor = file.get_tensor(name).contiguous()
            out[name] = sha(str((tensor.dtype, tuple(tensor.shape))).encode(), tensor.reshape(-1).view(-1).numpy().tobytes())
    return out


def of_archive(path: Path) -> str:
    """Digest of the tensors in a torch archive, without the names that torch counts up; the archive's own bytes where it is none."""
    import zipfile

    if not zipfile.is_zipfile(path):
        return sha(path.read_bytes())
    with zipfile.ZipFile(path) as archive:
        names = sorted(n for n in archive.namelist() if "/data/" in n)
        return sha(*(archive.read(n) for n in names))


def of_file(path: Path) -> str:
    """Digest of an exported file. The note that some formats keep counts without the command in it."""
    import zipfile

    if path.suffix == ".pt":
        return of_archive(path)
    if path.suffix == ".sog":
        with zipfile.ZipFile(path) as archive:
            return sha(*(_without_command(archive.read(name)) for name in sorted(archive.namelist())))
    data = path.read_bytes()
    if path.suffix == ".glb":  # 12 bytes of header, then chunks: length, kind, bytes
        size = int.from_bytes(data[12:16], "little")
        return sha(_without_command(data[20 : 20 + size]).rstrip(), data[20 + size :])
    if path.suffix == ".ply":
        end = data.find(b"end_header\n")
        return sha(_without_command(data[:end]), data[end:])
    return sha(data)


def _without_command(data: bytes) -> bytes:
    return re.sub(rb'"command": ?"[^"]*"', b'"command": ""', data)


def of_scores(folder: Path) -> str:
    """Digest of the pictures that `eval` drew and of its scores."""
    scores = json.loads((folder / "results.json").read_text())
    kept = {name: scores.get(name) for name in ("psnr", "ssim", "anchors", "view_count")}
    pictures = sorted((folder / "test" / "renders").glob("*.png"))
    return sha(json.dumps(kept, sort_keys=True).encode(), *(p.read_bytes() for p in pictures))


def trained(recipe: str, out: Path, *flags: str) -> dict[str, object]:
    """Train in two parts, score, and digest both."""
    words = ["train", recipe, "--out", str(out), *READ, *SHORT, *flags]
    run(*words, "--stop-at", str(STOP))
    run(*words, "--resume")
    run("eval", str(out), "--device", "cpu", "--no-lpips")
    return {"tensors": of_checkpoint(out), "pictures": of_scores(out)}


def exported(source: Path, out: Path) -> dict[str, str]:
    """Digests of a run's files in every format; "refused" where the format cannot hold it."""
    found = {}
    for format in FORMATS:
        place = out / format
        place.mkdir(parents=True, exist_ok=True)
        target = place if format == "anchors" else place / f"scene.{format.replace('compressed-', '')}"
        standard = [] if format in ("compact", "anchors") else ["--refine", "3", "--data", str(CAPTURE)]
        code = run("export", str(source), "--format", format, "--out", str(target), "--no-measure", *standard)
        if code:
            found[format] = f"refused with exit code {code}"
            continue
        for path in sorted(p for p in place.rglob("*") if p.is_file() and p.suffix != ".json"):
            name = str(path.relative_to(out))
            found[name] = of_file(path)
    return found


def imported(files: Path, out: Path) -> dict[str, object]:
    """Digests of runs made of exported files."""
    found: dict[str, object] = {}
    for format in ("compact", "anchors", "ply", "spz", "sog", "glb", "splat", "compressed-ply"):
        source = (
            files / format
            if format == "anchors"
            else next((p for p in sorted((files / format).glob("scene.*")) if p.suffix != ".json"), None)
        )
        if source is None or (not any(source.parent.glob("scene.*")) and format != "anchors"):
            continue
        target = out / format
        shutil.rmtree(target, ignore_errors=True)
        if code := run("import", str(source), *READ, "--out", str(target)):
            found[format] = f"refused with exit code {code}"
            continue
        run("eval", str(target), "--device", "cpu", "--no-lpips")
        found[format] = {"tensors": of_checkpoint(target), "pictures": of_scores(target)}
    return found


def recipes() -> dict[str, tuple[str, ...]]:
    """What is trained: the words after `train`, by name."""
    from scene_experts.training.recipes import RECIPES

    found: dict[str, tuple[str, ...]] = {recipe: (recipe,) for recipe in RECIPES}
    found["appearance"] = APPEARANCE
    found["sparse-adam"] = ("moe-gs", "--sparse-adam")
    found["random-background"] = ("scaffold-gs", "--random-background", "--antialias")
    return found


def everything(runs: Path, only: list[str], trained_in: Path | None = None) -> dict[str, object]:
    """Digests of trainings and files. only: names of recipes, "files of RECIPE", or "files"; empty for everything.

    trained_in: folder of runs that are there already, whose files are made; None trains them.
    """
    found: dict[str, object] = {}
    for name, (recipe, *flags) in recipes().items():
        has_files = name in (*FAMILIES, "appearance")
        wants_files = has_files and (not only or "files" in only or f"files of {name}" in only)
        if trained_in is None and (not only or name in only or wants_files):
            print(name, flush=True)
            digests = trained(recipe, runs / name, *flags)
            found |= {name: digests} if not only or name in only else {}
        if wants_files:
            print("files of", name, flush=True)
            files = runs / "files" / name
            found[f"files of {name}"] = exported((trained_in or runs) / name, files)
            found[f"imports of {name}"] = imported(files, runs / "imports" / name)
    return found


def reopened(runs: Path, recorded: dict) -> dict[str, object]:
    """What `eval` makes of run folders and `import` of files that another version wrote; the record's other entries as they are."""
    found = dict(recorded)
    for name, value in recorded.items():
        if (runs / name / "config.json").is_file():
            run("eval", str(runs / name), "--device", "cpu", "--no-lpips")
            found[name] = {**value, "pictures": of_scores(runs / name)}
        elif name.startswith("files of "):
            files = runs / "files" / name.removeprefix("files of ")
            imports = f"imports of {name.removeprefix('files of ')}"
            found[imports] = imported(files, runs / "imports-again" / name.removeprefix("files of "))
    return found


def differences(old: object, new: object, where: str = "") -> list[str]:
    if isinstance(old, dict) and isinstance(new, dict):
        names = sorted({*old, *new})
        return [line for n in names for line in differences(old.get(n), new.get(n), f"{where}/{n}")]
    return [] if old == new else [f"{where}: recorded {old}, now {new}"]


def chosen(recorded: dict, only: list[str], with_runs: bool = True) -> dict:
    """The entries of a record that `everything` makes for `only`."""

    def wanted(name: str) -> bool:
        files = name.startswith(("files of ", "imports of "))
        recipe = name.partition(" of ")[2]
        if not only:
            return files or with_runs
        return "files" in only or f"files of {recipe}" in only if files else with_runs and name in only

    return {name: value for name, value in recorded.items() if wanted(name)}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, help="folder for the run folders")
    group = parser.add_mutually_exclusive_group(required=True)
    for name in ("record", "check", "reopen"):
        group.add_argument(f"--{name}", type=Path, metavar="FILE")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="recipes, 'files of RECIPE', or 'files'")
    parser.add_argument("--runs", type=Path, dest="trained_in", metavar="DIR", help="make the files of the runs in DIR instead of training")
    args = parser.parse_args()
    if args.record:
        args.record.write_text(json.dumps(everything(args.runs, args.only, args.trained_in), indent=1, sort_keys=True) + "\n")
        return 0
    recorded = chosen(json.loads((args.check or args.reopen).read_text()), args.only, args.trained_in is None)
    found = everything(args.runs, args.only, args.trained_in) if args.check else reopened(args.runs, recorded)
    lines = differences(recorded, found)
    print("\n".join(lines) or "no digest differs")
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
