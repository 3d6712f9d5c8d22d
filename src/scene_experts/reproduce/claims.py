"""The paper's claims as a checklist: each claim, what our runs measured, and the verdict."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from scene_experts.reproduce.experiments import ROUTINGS
from scene_experts.reproduce.statistics import Difference, Verdict, difference, mean
from scene_experts.reproduce.store import Record

EQUAL = 0.1  # dB; a smaller difference counts as none
Groups = dict[str, list[Record]]  # records by recipe


@dataclass(frozen=True)
class Finding:
    """A claim and its verdict; None where no runs test it."""

    claim: str
    verdict: Verdict | None
    measured: str


@dataclass(frozen=True)
class Better:
    """The claim that recipe `a` scores better than recipe `b`."""

    claim: str
    a: str
    b: str
    metric: str = "psnr"


SCORES = (
    Better("MoE-GS has more PSNR than Scaffold-GS", "moe-gs", "scaffold-gs"),
    Better("MoE-GS with the distance as an input (the formula of the text) has more PSNR than Scaffold-GS", "moe-gs-dist", "scaffold-gs"),
    Better("MoE-GS has more SSIM than Scaffold-GS", "moe-gs", "scaffold-gs", "ssim"),
    Better("MoE-GS has less LPIPS (3DGS's variant) than Scaffold-GS", "moe-gs", "scaffold-gs", "lpips_3dgs"),
    Better("MoE-GS has more PSNR than 3DGS", "moe-gs", "3dgs"),
    Better("MoE-GS has more PSNR than Octree-GS", "moe-gs", "octree-gs"),
    Better("MoE-GS has more PSNR than SAGS", "moe-gs", "sags"),
    Better("the experts raise PSNR: MoE-GS over 'w/o MoE'", "moe-gs", "scaffold-gs-opacity"),
    Better("the experts lower LPIPS (3DGS's variant): MoE-GS over 'w/o MoE'", "moe-gs", "scaffold-gs-opacity", "lpips_3dgs"),
    Better("the curriculum raises PSNR: MoE-GS over 'w/o CL'", "moe-gs", "moe-gs-no-cl"),
    Better("L_load raises PSNR: MoE-GS over 'w/o L_load'", "moe-gs", "moe-gs-no-load"),
    Better("L_opacity raises PSNR: MoE-GS over 'w/o L_opacity'", "moe-gs", "moe-gs-no-opacity"),
    Better("the experts raise PSNR without the curriculum too: 'w/o CL' over 'w/o MoE'", "moe-gs-no-cl", "scaffold-gs-opacity"),
    Better("L_opacity alone raises the PSNR of Scaffold-GS", "scaffold-gs-opacity", "scaffold-gs"),
)


def check(records: Sequence[Record]) -> list[Finding]:
    """Judge every claim by these records."""
    by: Groups = {recipe: [r for r in records if r.recipe == recipe] for recipe in {r.recipe for r in records}}
    get: Callable[[str], list[Record]] = lambda name: by.get(name, [])  # noqa: E731
    return [
        *(compare_scores(claim, get(claim.a), get(claim.b)) for claim in SCORES),
        compare_sizes("MoE-GS is at most as large as Scaffold-GS", get("moe-gs"), get("scaffold-gs")),
        compare_sizes("L_opacity does not raise the size: MoE-GS over 'w/o L_opacity'", get("moe-gs"), get("moe-gs-no-opacity")),
        check_activation(get("scaffold-gs"), get("scaffold-gs-opacity")),
        check_balance(get("moe-gs-e3-top2"), get("moe-gs-e3-no-load")),
        *check_experts(by),
        compare_parts("the position as a router input does not help", by, {"": ("moe-gs-posrouter", "moe-gs")}, judge_no_gain),
    ]


def compare_scores(claim: Better, a: list[Record], b: list[Record]) -> Finding:
    """Judge whether `a` scores better than `b`, paired by view and seed."""
    d = difference(a, b, claim.metric)
    if d is None:
        return Finding(claim.claim, None, "no runs")
    return Finding(claim.claim, d.verdict(-1 if claim.metric.startswith("lpips") else 1), describe(d))


def judge_no_gain(d: Difference) -> Verdict:
    """Judge whether A has at most EQUAL more than B. No number of runs can show that a difference
    is 0."""
    return "confirmed" if d.high < EQUAL else "contradicted" if d.verdict(1) == "confirmed" else "undecided"


def judge_close(d: Difference) -> Verdict:
    """Judge whether A has at most EQUAL less than B."""
    return "confirmed" if d.low > -EQUAL else "contradicted" if d.high < -EQUAL else "undecided"


def describe(d: Difference) -> str:
    """Write a difference with its interval and its numbers of captures, views and seeds."""
    number = "+.2f" if d.metric == "psnr" else "+.4f"
    fitted = "" if d.fit is None or d.metric != "psnr" else f"; on training views {d.fit:+.2f} dB"
    across = "" if d.over_captures is None else f"; over capture means {d.over_captures[0]:{number}} to {d.over_captures[1]:{number}}"
    where = "1 capture" if d.captures == 1 else f"higher on {d.gains} of {d.captures} captures"
    seeds = count(d.seeds[1], "seed") if d.seeds[0] == d.seeds[1] else f"{d.seeds[0]} to {d.seeds[1]} seeds"
    return (
        f"{d.mean:{number}}{' dB' if d.metric == 'psnr' else ''} (95 % interval {d.low:{number}} to {d.high:{number}}{across}; "
        f"{where}, {count(d.views, 'view')}, {seeds}{fitted})"
    )


def count(number: int, thing: str) -> str:
    return f"{number} {thing}{'' if number == 1 else 's'}"


def pair(a: list[Record], b: list[Record]) -> tuple[list[Record], list[Record]]:
    """Return the records of both that have the same captures and seeds."""
    both = {(r.scene, r.seed) for r in a} & {(r.scene, r.seed) for r in b}
    return [r for r in a if (r.scene, r.seed) in both], [r for r in b if (r.scene, r.seed) in both]


def compare_sizes(claim: str, a: list[Record], b: list[Record]) -> Finding:
    """Judge whether A is at most 1 % larger than B."""
    a, b = pair(a, b)
    ours, theirs = mean(a, "size_mb"), mean(b, "size_mb")
    if ours is None or theirs is None:
        return Finding(claim, None, "no runs")
    verdict: Verdict = "confirmed" if ours.value <= 1.01 * theirs.value else "contradicted"
    return Finding(claim, verdict, f"{ours.value:.1f} MB against {theirs.value:.1f} MB (up to 1 % more counts as equal)")


def check_activation(plain: list[Record], hinged: list[Record]) -> Finding:
    """Judge the shares of active Gaussians of Table 3, without and with L_opacity."""
    claim = "L_opacity raises the share of active Gaussians from 35 - 41 % to 63 - 71 %"
    plain, hinged = pair(plain, hinged)
    low, high = mean(plain, "active_percent"), mean(hinged, "active_percent")
    if low is None or high is None:
        return Finding(claim, None, "no runs")
    inside, rises = 34.5 <= low.value < 41.5 and 62.5 <= high.value < 71.5, high.value > low.value
    verdict: Verdict = "confirmed" if inside else "undecided" if rises else "contradicted"
    words = "within the paper's ranges" if inside else "it rises, outside the paper's ranges" if rises else "it does not rise"
    return Finding(claim, verdict, f"{low.value:.1f} % to {high.value:.1f} %: {words}")


def busiest(record: Record, attribute: str = "cov") -> float | None:
    """Return the largest share of an expert times the number of experts; 1 is perfect balance."""
    found = record.results.get("experts", {}).get(attribute)
    shares = (found or {}).get("share") or (found or {}).get("mean_gate")
    return max(shares) * len(shares) if shares else None


def check_balance(loaded: list[Record], free: list[Record]) -> Finding:
    """Judge whether L_load balances the experts of the covariance network."""
    claim = "L_load balances the experts (covariance, three experts)"
    loaded, free = pair(loaded, free)
    with_load = [s for r in loaded if (s := busiest(r)) is not None]
    without = [s for r in free if (s := busiest(r)) is not None]
    if not with_load or not without:
        return Finding(claim, None, "no runs")
    a, b = float(np.mean(with_load)), float(np.mean(without))
    pairs = count(len(with_load), "pair")
    measured = f"the busiest expert has {a:.2f} times an equal share with L_load, {b:.2f} times without ({pairs} of runs)"
    every = all(x < y for x, y in zip(with_load, without))
    verdict: Verdict = "confirmed" if every and len(with_load) > 1 else "contradicted" if a > b else "undecided"
    return Finding(claim, verdict, measured)


def check_experts(by: Groups) -> list[Finding]:
    """Judge the claims of Figures 6 and 7: number of experts, routing, depth."""
    more = {f"{routing}, five over two": (f"moe-gs-e5-{routing}", f"moe-gs-e2-{routing}") for routing in ROUTINGS}
    top1 = {f"{n} experts": (f"moe-gs-e{n}-top2", f"moe-gs-e{n}-top1") for n in (3, 4, 5)}
    dense = {f"{n} experts": (f"moe-gs-e{n}-top2", f"moe-gs-e{n}-dense") for n in (3, 4, 5)}
    deeper = {f"{n} over 2": (f"scaffold-gs-depth{n}", "scaffold-gs-depth2") for n in (3, 4, 5, 6)}
    rises: Callable[[Difference], Verdict] = lambda d: d.verdict(1)  # noqa: E731
    return [
        compare_parts("PSNR rises with the number of experts for every routing (Figure 6)", by, more, rises),
        compare_parts("Top-1 has less PSNR than Top-2 (Figure 6)", by, top1, rises),
        compare_parts(f"Top-2 is close to dense (within {EQUAL} dB, Figure 6)", by, dense, judge_close),
        compare_parts("more linear layers do not help Scaffold-GS (Figure 7)", by, deeper, judge_no_gain),
    ]


def compare_parts(claim: str, by: Groups, pairs: dict[str, tuple[str, str]], judge: Callable[[Difference], Verdict]) -> Finding:
    """Judge a claim with several parts, each a difference of two recipes. One part can contradict
    it; all must have runs and confirm it."""
    found = {name: d for name, (a, b) in pairs.items() if (d := difference(by.get(a, []), by.get(b, []))) is not None}
    if not found:
        return Finding(claim, None, "no runs")
    verdicts = {name: judge(d) for name, d in found.items()}
    every, missing = set(verdicts.values()), [name for name in pairs if name not in found]
    confirmed = every == {"confirmed"} and not missing
    one: Verdict = "contradicted" if "contradicted" in every else "confirmed" if confirmed else "undecided"
    measured = [f"{name}: {verdicts[name]}, {describe(d)}" if name else describe(d) for name, d in found.items()]
    return Finding(claim, one, "; ".join([*measured, *([f"no runs: {', '.join(missing)}"] if missing else [])]))


def to_markdown(findings: Sequence[Finding]) -> str:
    """Format the tested claims as a table and the others as a list."""
    judged, others = [f for f in findings if f.verdict], [f.claim for f in findings if not f.verdict]
    if not judged:
        return "These runs test none of the claims.\n"
    lines = ["| claim | verdict | measured |", "|---|---|---|", *(f"| {f.claim} | {f.verdict} | {f.measured} |" for f in judged), ""]
    if others:
        lines += ["Claims without runs:", "", *(f"- {claim}" for claim in others), ""]
    return "\n".join(lines)
