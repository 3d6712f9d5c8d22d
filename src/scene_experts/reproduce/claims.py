"""The paper's claims as a checklist: what it says, what our runs measured, and whether that confirms, contradicts or leaves it open."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from scene_experts.reproduce.experiments import ROUTINGS
from scene_experts.reproduce.statistics import Difference, Verdict, difference, mean
from scene_experts.reproduce.store import Record

EQUAL = 0.1  # dB that count as no difference


@dataclass(frozen=True)
class Finding:
    claim: str
    verdict: Verdict | None  # None: no runs to judge by
    measured: str


def check(records: Sequence[Record]) -> list[Finding]:
    """Every claim, judged on the records at hand."""
    by = {recipe: [r for r in records if r.recipe == recipe] for recipe in {r.recipe for r in records}}
    get: Callable[[str], list[Record]] = lambda name: by.get(name, [])  # noqa: E731
    out = [
        better("MoE-GS has more PSNR than Scaffold-GS", get("moe-gs"), get("scaffold-gs")),
        better(
            "with the distance as an input (the text's formula) MoE-GS has more PSNR than Scaffold-GS",
            get("moe-gs-dist"),
            get("scaffold-gs"),
        ),
        better("MoE-GS has more SSIM than Scaffold-GS", get("moe-gs"), get("scaffold-gs"), "ssim"),
        better("MoE-GS has less LPIPS (3DGS's variant) than Scaffold-GS", get("moe-gs"), get("scaffold-gs"), "lpips_3dgs"),
        size("MoE-GS is at most as large as Scaffold-GS", get("moe-gs"), get("scaffold-gs")),
        better("MoE-GS has more PSNR than 3DGS", get("moe-gs"), get("3dgs")),
        better("MoE-GS has more PSNR than Octree-GS", get("moe-gs"), get("octree-gs")),
        better("MoE-GS has more PSNR than SAGS", get("moe-gs"), get("sags")),
        better("experts help: MoE-GS over 'w/o MoE'", get("moe-gs"), get("scaffold-gs-opacity")),
        better("experts lower LPIPS (3DGS's variant): MoE-GS over 'w/o MoE'", get("moe-gs"), get("scaffold-gs-opacity"), "lpips_3dgs"),
        better("the curriculum helps: MoE-GS over 'w/o CL'", get("moe-gs"), get("moe-gs-no-cl")),
        better("L_load helps: MoE-GS over 'w/o L_load'", get("moe-gs"), get("moe-gs-no-load")),
        better("L_opacity helps: MoE-GS over 'w/o L_opacity'", get("moe-gs"), get("moe-gs-no-opacity")),
        better("experts help without the curriculum too: 'w/o CL' over 'w/o MoE'", get("moe-gs-no-cl"), get("scaffold-gs-opacity")),
        size("L_opacity costs no size: MoE-GS is at most as large as 'w/o L_opacity'", get("moe-gs"), get("moe-gs-no-opacity")),
        better("L_opacity helps Scaffold-GS alone", get("scaffold-gs-opacity"), get("scaffold-gs")),
        activation(get("scaffold-gs"), get("scaffold-gs-opacity")),
        balance(get("moe-gs-e3-top2"), get("moe-gs-e3-no-load")),
        experts(by),
        top1(by),
        dense(by),
        depth(by),
        parts("the position in the router does not help", by, {"": ("moe-gs-posrouter", "moe-gs")}, useless),
    ]
    return out


def better(claim: str, a: list[Record], b: list[Record], metric: str = "psnr") -> Finding:
    """A scores better than B, paired."""
    d = difference(a, b, metric)
    return Finding(claim, None, "no runs") if d is None else Finding(claim, d.verdict(-1 if metric.startswith("lpips") else 1), describe(d))


def useless(d: Difference) -> Verdict:
    """Whether A brings nothing over B: at most EQUAL more (no amount of runs shows a difference to be 0)."""
    return "confirmed" if d.high < EQUAL else "contradicted" if d.verdict(1) == "confirmed" else "undecided"


def close(d: Difference) -> Verdict:
    """Whether A has at most EQUAL less than B."""
    return "confirmed" if d.low > -EQUAL else "contradicted" if d.high < -EQUAL else "undecided"


def describe(d: Difference) -> str:
    number = "+.2f" if d.metric == "psnr" else "+.4f"
    fitted = "" if d.fit is None or d.metric != "psnr" else f"; on training views {d.fit:+.2f} dB"
    where = "" if d.captures == 1 else f", higher on {d.gains}"
    seeds = many(d.seeds[1], "seed") if d.seeds[0] == d.seeds[1] else f"{d.seeds[0]} to {d.seeds[1]} seeds"
    return (
        f"{d.mean:{number}}{' dB' if d.metric == 'psnr' else ''} (95 % interval {d.low:{number}} to {d.high:{number}}; "
        f"{many(d.captures, 'capture')}{where}, {many(d.views, 'view')}, {seeds}{fitted})"
    )


def many(count: int, thing: str) -> str:
    return f"{count} {thing}{'' if count == 1 else 's'}"


def common(a: list[Record], b: list[Record]) -> tuple[list[Record], list[Record]]:
    """The records of both that stand for the same captures and seeds."""
    both = {(r.scene, r.seed) for r in a} & {(r.scene, r.seed) for r in b}
    return [r for r in a if (r.scene, r.seed) in both], [r for r in b if (r.scene, r.seed) in both]


def size(claim: str, a: list[Record], b: list[Record]) -> Finding:
    """A takes at most the bytes of B."""
    a, b = common(a, b)
    ours, theirs = mean(a, "size_mb"), mean(b, "size_mb")
    if ours is None or theirs is None:
        return Finding(claim, None, "no runs")
    verdict: Verdict = "confirmed" if ours.value <= 1.01 * theirs.value else "contradicted"
    return Finding(claim, verdict, f"{ours.value:.1f} MB against {theirs.value:.1f} MB (1 % is called equal)")


def activation(plain: list[Record], hinged: list[Record]) -> Finding:
    claim = "L_opacity raises the share of active Gaussians from 35 - 41 % to 63 - 71 %"
    plain, hinged = common(plain, hinged)
    low, high = mean(plain, "active_percent"), mean(hinged, "active_percent")
    if low is None or high is None:
        return Finding(claim, None, "no runs")
    inside = 34.5 <= low.value < 41.5 and 62.5 <= high.value < 71.5
    verdict: Verdict = "confirmed" if inside else "undecided" if high.value > low.value else "contradicted"
    words = "as the paper has it" if inside else "it rises, from and to other levels" if high.value > low.value else "it does not rise"
    return Finding(claim, verdict, f"{low.value:.1f} % to {high.value:.1f} %: {words}")


def spread(record: Record, attribute: str = "cov") -> float | None:
    """The largest share of any expert, times the number of experts: 1 is perfect balance."""
    found = record.results.get("experts", {}).get(attribute)
    shares = (found or {}).get("share") or (found or {}).get("mean_gate")
    return max(shares) * len(shares) if shares else None


def balance(loaded: list[Record], free: list[Record]) -> Finding:
    claim = "L_load balances the experts (covariance, three experts)"
    loaded, free = common(loaded, free)
    with_load = [s for r in loaded if (s := spread(r)) is not None]
    without = [s for r in free if (s := spread(r)) is not None]
    if not with_load or not without:
        return Finding(claim, None, "no runs")
    a, b = float(np.mean(with_load)), float(np.mean(without))
    measured = f"the busiest expert has {a:.2f} times its fair share with it, {b:.2f} without ({many(len(with_load), 'pair')} of runs)"
    every = all(x < y for x, y in zip(with_load, without))
    verdict: Verdict = "confirmed" if every and len(with_load) > 1 else "contradicted" if a > b else "undecided"
    return Finding(claim, verdict, measured)


def experts(by: dict[str, list[Record]]) -> Finding:
    claim = "PSNR rises with the number of experts, for every routing (Figure 6)"
    pairs = {f"{r}, five over two": (f"moe-gs-e5-{r}", f"moe-gs-e2-{r}") for r in ROUTINGS}
    return parts(claim, by, pairs, lambda d: d.verdict(1))


def top1(by: dict[str, list[Record]]) -> Finding:
    claim = "Top-1 has less PSNR than Top-2 (Figure 6)"
    return parts(claim, by, {f"{n} experts": (f"moe-gs-e{n}-top2", f"moe-gs-e{n}-top1") for n in (3, 4, 5)}, lambda d: d.verdict(1))


def dense(by: dict[str, list[Record]]) -> Finding:
    claim = f"Top-2 is close to dense (within {EQUAL} dB, Figure 6)"
    return parts(claim, by, {f"{n} experts": (f"moe-gs-e{n}-top2", f"moe-gs-e{n}-dense") for n in (3, 4, 5)}, close)


def depth(by: dict[str, list[Record]]) -> Finding:
    claim = "more linear layers do not help Scaffold-GS (Figure 7)"
    return parts(claim, by, {f"{n} over 2": (f"scaffold-gs-depth{n}", "scaffold-gs-depth2") for n in (3, 4, 5, 6)}, useless)


def parts(claim: str, by: dict[str, list[Record]], pairs: dict[str, tuple[str, str]], judge: Callable[[Difference], Verdict]) -> Finding:
    """A claim in several parts, each the difference of two recipes with its verdict: contradicted by any, confirmed by all."""
    found = {name: d for name, (a, b) in pairs.items() if (d := difference(by.get(a, []), by.get(b, []))) is not None}
    if not found:
        return Finding(claim, None, "no runs")
    verdicts = {name: judge(d) for name, d in found.items()}
    every = set(verdicts.values())
    one: Verdict = "contradicted" if "contradicted" in every else "confirmed" if every == {"confirmed"} else "undecided"
    return Finding(claim, one, "; ".join(f"{name}: {verdicts[name]}, {describe(d)}" if name else describe(d) for name, d in found.items()))


def to_markdown(findings: Sequence[Finding]) -> str:
    """The judged ones as a table, and the others in a line."""
    judged, others = [f for f in findings if f.verdict], [f.claim for f in findings if not f.verdict]
    lines = ["| claim | verdict | measured |", "|---|---|---|", *(f"| {f.claim} | {f.verdict} | {f.measured} |" for f in judged)]
    lines = [*lines, ""] if judged else []
    if not judged:
        return "These runs judge none of them.\n"
    if others:
        lines += [f"Without the runs to judge by: {'; '.join(others)}.", ""]
    return "\n".join(lines)
