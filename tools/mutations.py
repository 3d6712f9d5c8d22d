"""Put small errors into the sources, one after the other, and see whether the tests of the changed file notice.

    python tools/mutations.py              every mutation
    python tools/mutations.py mcmc paint   those of files whose path holds one of these words

The tests are the fast ones of the file that mirrors the changed one. A file is written back before the next one changes. Exit code 1 if
no test failed for a mutation, 2 if a text to change is not there exactly once.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MUTATIONS = (  # file of the package, text, text in its place
    ("scene/anchors/few_views.py", "distance / math.sqrt(3.0)", "distance / math.sqrt(2.0)"),
    ("scene/anchors/smoothing.py", "(g.scales / scales).prod(1)", "(g.scales / scales).mean(1)"),
    ("training/losses.py", "return E * (share", "return (E - 1) * (share"),
    ("strategy/mcmc.py", "min(cap, wanted) if cap", "min(cap + 1, wanted) if cap"),
    ("scene/anchors/experts.py", "step <= self.config.warmup", "step < self.config.warmup"),
    ("training/state.py", "range(step - self.cfg.batch + 1, step + 1)", "range(step - self.cfg.batch, step)"),
    ("files/formats/splat.py", "np.argsort(-size", "np.argsort(size"),
    ("scene/anchors/rates.py", "/ (1.0 - self.anneal_from)", "/ (2.0 - self.anneal_from)"),
    ("core/table.py", "            self.averages[name] = value.clone()", "            pass"),
    ("view/paint.py", "render.alpha > 0.5", "render.alpha > 0.05"),
)


def is_caught(file: str, old: str, new: str) -> bool:
    """Whether a test fails with `new` in the place of `old`."""
    path = ROOT / "src" / "scene_experts" / file
    text = path.read_text()
    if text.count(old) != 1:
        print(f"expected {old!r} once in {file}, found it {text.count(old)} times; correct {Path(__file__).name}")
        raise SystemExit(2)
    tests = ROOT / "tests" / "unit" / Path(file).parent / f"test_{Path(file).name}"
    command = [sys.executable, "-m", "pytest", "-x", "-m", "not slow", "-p", "no:cacheprovider", str(tests)]
    try:
        path.write_text(text.replace(old, new))
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    finally:
        path.write_text(text)
    if done.returncode not in (0, 1):  # the tests did not run
        raise SystemExit(done.stdout + done.stderr)
    return done.returncode == 1


def main(words: list[str]) -> int:
    missed = 0
    for file, old, new in MUTATIONS:
        if not words or any(word in file for word in words):
            caught = is_caught(file, old, new)
            missed += not caught
            print(f"{'caught' if caught else 'MISSED'}  {file}: {old.strip()} -> {new.strip()}", flush=True)
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
