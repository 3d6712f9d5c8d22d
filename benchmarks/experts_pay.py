"""When do experts pay? One network, one network with the parameters of five experts, and five experts, by hidden width and feature size.

    python benchmarks/experts_pay.py results/records --figure docs/figures/experts_pay.png

Reads the records of runs (results/README.md has the command of the trainings) and prints the table of results/experts-pay.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from scene_experts.reproduce import store
from scene_experts.scene.anchors.rates import Rates

CAPTURES = ("colosseum", "bonsai")
CASES = ((32, 8, 40), (32, 32, 160), (32, 160, 800), (16, 32, 160), (8, 32, 160))  # features, width, width of equal parameters
ROWS = ("one", "equal", "experts")
ANNEAL, NETWORKS = 0.1, 2.0  # the rates of all these runs
MARKS = {"one": "o", "equal": "s", "experts": "^"}


@dataclass(frozen=True)
class Score:
    """Scores of a run on the held-out views."""

    psnr: float
    lpips: float
    megabytes: float


Key = tuple[str, int, int, bool]  # capture, features, hidden width, whether it has experts


def read_scores(records: Path) -> dict[Key, Score]:
    """Return the scores of the runs of this comparison among the records."""
    found = {}
    for record in store.load(records):
        train, scene = record.config.train, record.config.train.scene
        if (
            record.scene in CAPTURES
            and (record.seed, train.iterations, record.config.data.resolution) == (0, 3000, "longest:400")
            and isinstance(train.rates, Rates)
            and (train.rates.anneal, train.rates.networks) == (ANNEAL, NETWORKS)
            and record.recipe in ("scaffold-gs-opacity", "moe-gs")
            and is_fair(record.recipe, scene.decoder)
        ):
            key = record.scene, scene.F, scene.hidden, record.recipe == "moe-gs"
            found[key] = Score(record.results["psnr"], record.results["lpips"], record.results["size"]["MB"])
    return found


def is_fair(recipe: str, decoder: Any) -> bool:
    """Whether experts start with the variance of one network and have gates that are their margins."""
    return recipe != "moe-gs" or (decoder.expert_init, decoder.router.name) == ("variance", "margin")


def cells(scores: dict[Key, Score], capture: str, features: int, width: int, equal: int) -> list[Score | None]:
    """Return the scores of a case in the order of ROWS."""
    return [scores.get((capture, features, hidden, experts)) for hidden, experts in ((width, False), (equal, False), (width, True))]


def table(scores: dict[Key, Score]) -> Iterator[str]:
    """Yield the lines of the table in Markdown."""
    yield "| capture | features | width | PSNR: one | equal | experts | LPIPS: one | equal | experts | MB: one | equal | experts |"
    yield "|" + "---|" * 12
    for capture in CAPTURES:
        for features, width, equal in CASES:
            found = cells(scores, capture, features, width, equal)
            numbers = [
                "-" if score is None else form.format(getattr(score, name))
                for name, form in (("psnr", "{:.2f}"), ("lpips", "{:.3f}"), ("megabytes", "{:.1f}"))
                for score in found
            ]
            yield f"| {capture} | {features} | {width} | {' | '.join(numbers)} |"


def draw(scores: dict[Key, Score], path: Path) -> None:
    """Draw PSNR over hidden width and over feature size, one panel per capture and axis."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 4, figsize=(12, 3.2), layout="constrained")
    for panel, (capture, varied) in zip(axes, product(reversed(CAPTURES), ("hidden width", "features"))):
        over = 1 if varied == "hidden width" else 0  # the number of a case that varies
        cases = sorted(case for case in CASES if (case[0] == 32 if over else case[1] == 32))
        for index, row in enumerate(ROWS):
            points = [(case[over], score.psnr) for case in cases if (score := cells(scores, capture, *case)[index]) is not None]
            panel.plot(*zip(*points), marker=MARKS[row], label=row)
        panel.set(title=capture, xlabel=varied, xscale="log")
        panel.set_xticks([case[over] for case in cases], [str(case[over]) for case in cases])
        panel.set_xticks([], minor=True)
        panel.grid(alpha=0.3)
    for first, second in ((0, 1), (2, 3)):  # both panels of a capture
        ends = [end for index in (first, second) for end in axes[index].get_ylim()]
        for index in (first, second):
            axes[index].set_ylim(min(ends), max(ends))
    axes[0].set_ylabel("PSNR, dB")
    axes[0].legend()
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("records", type=Path)
    parser.add_argument("--figure", type=Path)
    args = parser.parse_args()
    scores = read_scores(args.records)
    print("\n".join(table(scores)))
    if args.figure:
        draw(scores, args.figure)


if __name__ == "__main__":
    main()
