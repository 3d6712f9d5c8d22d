"""The checklist: each claim judged from records whose answer is known."""

from scene_experts.reproduce.claims import check, to_markdown
from support.records import record


def found(records):
    return {f.claim: f for f in check(records)}


def get(records, word):
    return next(f for claim, f in found(records).items() if word in claim)


def test_without_runs_nothing_is_claimed():
    findings = check([])
    assert len(findings) >= 16 and all(f.verdict is None for f in findings)
    assert "|" not in to_markdown(findings)
    some = check([record("moe-gs"), record("scaffold-gs")])
    table, others = to_markdown(some).split("Claims without runs:")
    assert [f.claim for f in some if f.verdict] == [line.split(" | ")[0][2:] for line in table.splitlines()[2:] if line]
    assert [f.claim for f in some if not f.verdict] == [line[2:] for line in others.split("\n") if line]


def test_more_psnr_at_equal_size():
    runs = [record("moe-gs", psnr=30.8, mb=9.0), record("scaffold-gs", psnr=30.0)]
    assert get(runs, "more PSNR than Scaffold-GS").verdict == "confirmed"
    assert get(runs, "at most as large").verdict == "confirmed"
    runs = [record("moe-gs", psnr=29.0, mb=12.0), record("scaffold-gs", psnr=30.0)]
    assert get(runs, "more PSNR than Scaffold-GS").verdict == "contradicted" and get(runs, "at most as large").verdict == "contradicted"


def test_other_scores_are_judged_by_their_own_sign_and_noise():
    ours = [record("moe-gs", scene=s) for s in "vwxyz"]
    theirs = [record("scaffold-gs", scene=s) for s in "vwxyz"]
    for records, lpips, ssim in ((ours, 0.19, 0.902), (theirs, 0.2, 0.901)):
        for each in records:
            for scores in each.per_view.values():
                scores.update(lpips_3dgs=lpips, ssim=ssim)
    found = get([*ours, *theirs], "less LPIPS")
    assert found.verdict == "confirmed" and found.measured.startswith("-0.0100 (95 % interval -0.01") and "dB" not in found.measured
    assert get([*ours, *theirs], "more SSIM").verdict == "undecided"


def test_activation_is_judged_by_its_levels():
    pair = lambda low, high: [record("scaffold-gs", active=low), record("scaffold-gs-opacity", active=high)]  # noqa: E731
    assert get(pair(0.37, 0.65), "share of active").verdict == "confirmed"
    assert get(pair(0.55, 0.85), "share of active").verdict == "undecided"
    assert get(pair(0.55, 0.5), "share of active").verdict == "contradicted"


def test_balance_is_the_busiest_experts_share():
    even = {"experts": {"cov": {"share": [0.34, 0.33, 0.33], "mean_gate": []}}}
    lone = {"experts": {"cov": {"share": [0.9, 0.05, 0.05], "mean_gate": []}}}
    runs = [record("moe-gs-e3-top2", **even), record("moe-gs-e3-no-load", **lone)]
    assert get(runs, "balances").verdict == "undecided"  # one pair is none too many
    runs += [record("moe-gs-e3-top2", seed=1, **even), record("moe-gs-e3-no-load", seed=1, **lone)]
    assert get(runs, "balances").verdict == "confirmed" and "1.02" in get(runs, "balances").measured


def test_depth_that_helps_contradicts():
    flat = [record("scaffold-gs-depth2", psnr=30.0), *(record(f"scaffold-gs-depth{n}", psnr=29.0) for n in (3, 4, 5, 6))]
    assert get(flat, "linear layers").verdict == "confirmed"
    assert get([*flat[:2], record("scaffold-gs-depth4", psnr=32.0)], "linear layers").verdict == "contradicted"


def test_parts_without_runs_are_named_and_leave_a_claim_undecided():
    runs = [record("scaffold-gs-depth2", psnr=30.0), record("scaffold-gs-depth3", psnr=29.0)]
    found = get(runs, "linear layers")
    assert found.verdict == "undecided" and found.measured.endswith("no runs: 4 over 2, 5 over 2, 6 over 2")


def test_no_difference_confirms_that_something_does_not_help():
    scenes = [f"scene {i}" for i in range(40)]
    runs = [record(recipe, scene=s, seed=k) for recipe in ("moe-gs", "moe-gs-posrouter") for s in scenes for k in (0, 1, 2)]
    assert get(runs, "position").verdict == "confirmed"
    assert get(runs[:1] + runs[120:121], "position").verdict == "undecided"
    assert get([record("moe-gs-posrouter", psnr=31), record("moe-gs")], "position").verdict == "contradicted"


def test_number_of_experts_and_top_2_near_dense():
    runs = [
        record(f"moe-gs-e{n}-{r}", psnr=p + 0.3 * n, scene=s)
        for n in (2, 3, 4, 5)
        for r, p in (("top1", 28.5), ("top2", 29.0), ("dense", 29.0))
        for s in "vwxyz"
    ]
    assert get(runs, "rises with the number").verdict == "confirmed"
    assert get(runs, "Top-1 has less").verdict == "confirmed"
    near = get(runs, "close to dense")
    assert near.verdict == "undecided" and "undecided" in near.measured  # 5 pairs whose seeds differ by 0.2 dB do not tell 0.1 dB
    better = [record(f"moe-gs-e{n}-top2", psnr=31, seed=k, scene=s) for n in (3, 4, 5) for k in (0, 1, 2) for s in "vwxyz"]
    assert get([*better, *(r for r in runs if r.recipe.endswith("dense"))], "close to dense").verdict == "confirmed"
