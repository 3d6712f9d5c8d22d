"""The figures of README.md, docs/results.md and the pages of results/ are those of the records."""

import functools
import importlib.util
import itertools
import json
import re
import shlex
import statistics
import sys
from pathlib import Path

import pytest

from scene_experts import cli
from scene_experts.reproduce import figures, store
from scene_experts.reproduce.statistics import SEED_SD
from support.places import ROOT

RECORDS = ROOT / "results" / "records"
pytestmark = pytest.mark.skipif(not RECORDS.is_dir(), reason="a source distribution leaves results/ out")
CAPTURES = ("buddha", "fox", "kitchen", "bonsai", "fern", "colosseum", "brighton")
SEEDED = ("scaffold-gs", "moe-gs", "moe-gs-dist")


OURS, PAPER, SUMMARY = "results/scene-experts.md", "results/moe-gs.md", "docs/results.md"


def lines(page: str) -> list[str]:
    return (ROOT / page).read_text().splitlines()


def prose(page: str) -> str:
    """The text of a page without its line breaks."""
    return " ".join((ROOT / page).read_text().split())


records = functools.cache(store.load)


def runs_of(capture: str, recipe: str, iterations: int) -> list[store.Record]:
    """The records of a recipe on a capture at its shipped resolution."""
    found = [r for r in records(RECORDS) if (r.scene, r.recipe) == (capture, recipe) and r.config.data.resolution == "auto"]
    return sorted((r for r in found if r.results["iterations"] == iterations), key=lambda r: r.seed)


def recorded(capture: str, recipe: str, iterations: int) -> list[dict]:
    """Their results, one a seed, in the order of the seeds."""
    return [record.results for record in runs_of(capture, recipe, iterations)]


def psnr(runs: list[dict]) -> str:
    values = [run["psnr"] for run in runs]
    return f"{statistics.fmean(values):.2f}" + (f" ± {statistics.stdev(values):.2f}" if len(values) > 1 else "")


def mean(runs: list[dict], *path: str, digits: int, factor: float = 1.0) -> str:
    values = []
    for run in runs:
        for key in path:
            run = run[key]
        values.append(factor * run)  # type: ignore[operator]
    return f"{statistics.fmean(values):,.{digits}f}"


def scores(runs: list[dict]) -> list[str]:
    """PSNR, SSIM, the two LPIPS, MB, anchors, active %."""
    three = [mean(runs, name, digits=3) for name in ("ssim", "lpips", "lpips_3dgs")]
    size, anchors = mean(runs, "size", "MB", digits=1), mean(runs, "anchors", digits=0)
    return [psnr(runs), *three, size, anchors, mean(runs, "activation_ratio", digits=1, factor=100)]


def row(*cells: object) -> str:
    return f"| {' | '.join(map(str, cells))} |"


@pytest.mark.parametrize("capture", CAPTURES)
@pytest.mark.parametrize("recipe", SEEDED)
def test_means_over_seeds(capture, recipe):
    runs = recorded(capture, recipe, 7000)
    assert row(capture, recipe, len(runs), *scores(runs), mean(runs, "sharpness", "ratio", digits=2)) in lines(PAPER)


ORDER = ("fox", "colosseum", "bonsai", "buddha", "brighton", "fern", "kitchen")
SCORES = ((("psnr",), 2), (("lpips",), 3), (("size", "MB"), 1))
BESIDE = ("scaffold-gs", "scaffold-gs-opacity", "moe-gs", "scene-experts-one", "scene-experts-wide", "scene-experts")


def as_it_is(capture: str, recipe: str, distance: bool = False) -> list[dict]:
    """The results of the recipe as it is now, one a seed: of 7,000 iterations at the shipped resolution.

    distance: whether the decoders see the distance.
    """
    found = {}
    for record in runs_of(capture, recipe, 7000):
        train, scene = record.config.train, record.config.train.scene
        if distance == bool(getattr(scene, "add_dist", ())) and train.batch == 1 and getattr(scene, "F", 32) == 32:
            assert record.seed not in found, record.key
            found[record.seed] = record.results
    return [found[seed] for seed in sorted(found)]


def beside(recipe: str, runs: dict[str, list[dict]]) -> list[str]:
    """The rows of a recipe in the tables of PSNR, LPIPS and MB: means over seeds, and their mean over captures."""
    found = []
    for path, digits in SCORES:
        whole = [run for capture in ORDER for run in runs[capture]]
        found.append(row(recipe, *(mean(runs[c], *path, digits=digits) for c in ORDER), mean(whole, *path, digits=digits)))
    return found


@pytest.mark.parametrize("recipe", BESIDE)
def test_scene_experts_beside_its_controls(recipe):
    runs = {capture: as_it_is(capture, recipe) for capture in ORDER}
    assert {len(found) for found in runs.values()} == {3}
    plain, summary = ([line.replace("**", "") for line in lines(page)] for page in (OURS, SUMMARY))
    rows = beside(recipe, runs)
    assert all(expected in plain for expected in rows)
    means = [cells.split(" | ")[-1].removesuffix(" |") for cells in rows]
    assert sum(bool(re.match(rf"\| {recipe}( \([^|]*\))? \| {' . '.join(map(re.escape, means))} \|", line)) for line in summary) == 1


def fullest(capture: str) -> list[dict]:
    """The run of 3DGS-MCMC with the most Gaussians: some captures have two, with growth of 5 % and of 6 % a step."""
    runs = recorded(capture, "3dgs-mcmc", 7000)
    return [max(runs, key=lambda run: run["anchors"])]


@pytest.mark.parametrize("recipe", ["3dgs-mcmc", "scene-experts"])
def test_3dgs_mcmc_at_the_same_bytes(recipe):
    runs = {capture: fullest(capture) if recipe == "3dgs-mcmc" else as_it_is(capture, recipe)[:1] for capture in ORDER}
    plain = [line.replace("**", "") for line in lines(OURS)]
    for name, expected in zip(("PSNR", "LPIPS", "MB"), beside(recipe, runs), strict=True):
        assert expected.replace(f"| {recipe} |", f"| {name}, {recipe} |", 1) in plain


@pytest.mark.parametrize(
    ("name", "recipe", "distance"),
    [
        ("scaffold-gs", "scaffold-gs", False),
        ("scaffold-gs-dist", "scaffold-gs-dist", True),
        ("scaffold-gs-opacity", "scaffold-gs-opacity", False),
        ("scaffold-gs-opacity with the distance", "scaffold-gs-opacity", True),
        ("moe-gs", "moe-gs", False),
        ("moe-gs-dist", "moe-gs-dist", True),
    ],
)
def test_the_distance_as_an_input(name, recipe, distance):
    runs = [as_it_is(capture, recipe, distance)[:1] for capture in ("fox", "colosseum", "bonsai")]
    cells = [mean(found, *path, digits=n) if found else "-" for path, n in SCORES for found in runs]
    assert row(name, *cells) in lines(PAPER)


@pytest.mark.parametrize("capture", ORDER)
def test_sags_beside_scene_experts(capture):
    sags, ours = (as_it_is(capture, recipe)[:1] for recipe in ("sags", "scene-experts"))
    if sags:
        pairs = [mean(runs, *path, digits=n) for path, n in SCORES for runs in (sags, ours)]
        ratio = f"{sags[0]['cpu_seconds'] / ours[0]['cpu_seconds']:.1f}"
        assert row(capture, *pairs, ratio) in [line.replace("**", "") for line in lines(OURS)]


def cells_of(section: str, page: str) -> dict[str, list[str]]:
    """The rows of the first table of a section, by their first cell."""
    part = page[page.index(f"### captures: {section}\n") :].split("\n###")[0]
    rows = [[cell.strip().strip("*") for cell in line.split("|")[1:-1]] for line in part.splitlines() if line.startswith("| ")]
    return {name: cells for name, *cells in rows}


def test_the_parts_of_scene_experts():
    page = (ROOT / "results/ablation/README.md").read_text()
    psnr, lpips = (cells_of(f"{score} minus that of scene-experts", page) for score in ("PSNR", "LPIPS (3DGS)"))
    sizes = cells_of("means over fox, bonsai, colosseum", page)
    for name in ("one network", "no hinge", "width 32", "networks x 1", "constant rates", "scaffold-gs"):
        assert row(name, *psnr[name][:4], lpips[name][3], sizes[name][3]) in lines(OURS)


def test_the_switches_that_scene_experts_does_not_use():
    page = (ROOT / "results/switches/README.md").read_text()
    psnr, lpips = (cells_of(f"{score} minus that of scene-experts", page) for score in ("PSNR", "LPIPS (3DGS)"))
    sizes = cells_of("means over fox, colosseum", page)
    for name in ("average", "absolute gradients", "error views", "masks", "residuals", "later growth", "smoothing"):
        written = next(line for line in lines(OURS) if line.startswith(f"| {name} (`--"))
        size, drawn = (sizes[name][i].strip("*") for i in (3, 7))
        assert written.endswith(row(*psnr[name][:3], lpips[name][2], size, drawn)[1:]), name


@pytest.mark.parametrize("recipe", [recipe for recipe in BESIDE if recipe != "scene-experts"])
def test_the_gains_of_scene_experts_are_those_of_its_page(recipe):
    page = (ROOT / "results/confirmation/README.md").read_text()
    section = page[page.index(f"### captures: PSNR minus that of {recipe}\n") :]
    cells = next(line for line in section.splitlines() if line.startswith("| scene-experts |")).split("|")
    gain, across = cells[-4].strip(), cells[-2].strip()
    theirs, ours = (dict(zip(ORDER, (as_it_is(capture, name) for capture in ORDER), strict=True)) for name in (recipe, "scene-experts"))
    lower = sum(float(mean(ours[c], "lpips", digits=9)) < float(mean(theirs[c], "lpips", digits=9)) for c in ORDER)
    ratio = statistics.fmean(float(mean(ours[c], "size", "MB", digits=9)) / float(mean(theirs[c], "size", "MB", digits=9)) for c in ORDER)
    written = next(line for line in lines(SUMMARY) if line.startswith(f"| {recipe} ") and line.count("|") == 9)
    assert written.endswith(f" | {gain} dB | {across} | {('three', 'four', 'five', 'six', 'seven')[lower - 3]} of seven | {ratio:.2f} |")


def in_folds(capture, recipe):
    """Scores by view and MB by fold of one recipe in five folds, with the near plane where there are both."""
    views, sizes = {}, {}
    runs = json.loads((ROOT / f"results/records/{capture}.json").read_text())["runs"]
    for run in sorted(runs, key=lambda run: bool(run["config"]["train"].get("near_share")) is (recipe == "one-network")):
        train, split = run["config"]["train"], str(run["config"]["data"].get("split"))
        if run["recipe"] == recipe and re.fullmatch("fold:[1-5]/5", split) and train["iterations"] == 4000 and run["seed"] == 0:
            sizes[split] = run["results"]["size"]["MB"]
            scores = run["per_view"]["scores"]
            views |= {name: (scores["psnr"][i], scores["lpips"][i]) for i, name in enumerate(run["per_view"]["names"])}
    assert len(sizes) == 5
    return views, statistics.fmean(sizes.values())


def test_the_default_on_five_folds_is_that_of_the_records():
    gains, ratios, bytes_ = [], [], []
    for capture in ("fern", "sceaux", "banana", "brighton", "kitchen"):
        (ours, our_size), (theirs, their_size) = in_folds(capture, "one-network"), in_folds(capture, "scaffold-gs")
        assert ours.keys() == theirs.keys()
        gains.append(statistics.fmean(ours[n][0] - theirs[n][0] for n in ours))
        ratios.append(sum(v[1] for v in ours.values()) / sum(v[1] for v in theirs.values()))
        bytes_.append(our_size / their_size)
        assert f"+{gains[-1]:.2f} ±" in prose("docs/results.md") and f"+{gains[-1]:.2f} ±" in prose("results/default.md")
    gain, ratio = f"{statistics.fmean(gains):.2f} dB", f"{statistics.fmean(ratios):.2f}"
    assert f"With 11 to 24 photographs, {gain} more PSNR and {ratio} times the LPIPS of Scaffold-GS at its size" in prose("README.md")
    assert f"+{gain} (± 0.56 over captures), LPIPS {ratio}x, bytes {statistics.fmean(bytes_):.2f}x" in prose("results/default.md")


def test_ssim_and_lpips_over_scaffold_gs_are_those_of_the_page():
    page, doc = (ROOT / "results/confirmation/README.md").read_text(), prose(SUMMARY)
    for score, start in (("SSIM", "SSIM changes by "), ("LPIPS (3DGS)", "LPIPS (3DGS) by ")):
        section = page[page.index(f"### captures: {score} minus that of scaffold-gs\n") :]
        cells = next(line for line in section.splitlines() if line.startswith("| scene-experts |")).split("|")
        assert re.search(rf"{re.escape(start + cells[-4].strip())} \((over captures )?{re.escape(cells[-2].strip())}\)", doc), score


@pytest.mark.parametrize("capture", CAPTURES)
def test_differences_seed_by_seed(capture):
    scaffold, moe = (recorded(capture, recipe, 7000) for recipe in SEEDED[:2])
    gains = [theirs["psnr"] - ours["psnr"] for ours, theirs in zip(scaffold, moe, strict=True)]
    assert row(capture, *(f"{gain:+.2f}" for gain in (*gains, statistics.fmean(gains)))) in lines(PAPER)


def pooled(one: str, other: str, score: str = "psnr") -> float:
    """The standard deviation over seeds of the difference of two recipes in a score (PSNR in dB), pooled over the captures."""
    pairs = [zip(*(as_it_is(c, recipe, recipe.endswith("dist")) for recipe in (one, other)), strict=True) for c in CAPTURES]
    return statistics.fmean(statistics.variance([a[score] - b[score] for a, b in pair]) for pair in pairs) ** 0.5


def test_how_far_another_seed_moves_a_difference():
    page, ours = prose(PAPER), ("scene-experts", "scene-experts-one")
    found = {pair: pooled(*pair) for pair in itertools.combinations((*SEEDED, *ours), 2)}
    first = [sd for pair, sd in found.items() if set(pair) <= set(SEEDED)]
    others = [sd for pair, sd in found.items() if set(pair) & set(ours)]
    assert f"the difference of two of them by {min(first):.2f} to {max(first):.2f} dB" in page
    assert f"Pairs with `scene-experts` or `scene-experts-one` have {min(others):.2f} to {max(others):.2f} dB" in page
    assert f"assume the {SEED_SD['psnr']} dB that all ten pairs have together (SSIM and LPIPS {SEED_SD['ssim']:g})" in page
    for score, assumed in SEED_SD.items():
        together = statistics.fmean(pooled(*pair, score) ** 2 for pair in found) ** 0.5
        assert together == pytest.approx(assumed, abs=0.005 if score == "psnr" else 0.0005)


@pytest.mark.parametrize("capture", ["buddha", "fox", "bonsai"])
def test_the_whole_schedule(capture):
    runs = recorded(capture, "moe-gs", 30_000)
    start = row(capture, *scores(runs), mean(runs, "sharpness", "ratio", digits=2))[:-2]
    assert len(runs) == 1 and any(line.startswith(start) for line in lines(PAPER))


def test_the_whole_schedule_beside_the_others():
    for recipe, name in (("scaffold-gs", "scaffold-gs"), ("scaffold-gs-opacity", 'scaffold-gs-opacity ("w/o MoE")'), ("moe-gs", "moe-gs")):
        assert row(name, *scores(recorded("fox", recipe, 30_000))) in lines(PAPER)


def test_the_claims_are_quoted_as_they_were_judged():
    claims = {cells[1].strip(): cells[3] for line in lines("results/seeds/README.md") if len(cells := line.split("|")) == 5}
    page, summary = prose(PAPER), prose(SUMMARY)
    number = r"([+-][\d.]+)"
    for claim, digits in (("PSNR than Scaffold", 2), ("SSIM", 4), ("LPIPS (3DGS's variant)", 4)):
        measured = next(text for name, text in claims.items() if name.startswith("MoE-GS") and claim in name)
        gain, low, high = re.search(rf"{number}(?: dB)? \(95 % interval {number} to {number};", measured).groups()
        assert len(gain.partition(".")[2]) == digits and re.search(rf"{re.escape(gain)}(?: dB)?\s+\({claimed(low, high)}", page), claim
        across = re.search(rf"over capture means {number} to {number};", measured)
        assert across is not None and f"{across[1]} to {across[2]}" in page, claim
        if digits == 2:
            spans = f"(over views and seeds {low} to {high}; over captures {across[1]} to {across[2]})"
            assert f"The gain over Scaffold-GS is {gain} dB** {spans}" in summary
    moe, scaffold = re.search(r"([\d.]+) MB against ([\d.]+) MB", claims["MoE-GS is at most as large as Scaffold-GS"]).groups()
    assert f"at {moe} against {scaffold} MB" in page


def claimed(low: str, high: str) -> str:
    return rf"(?:95 % interval )?{re.escape(low)} to {re.escape(high)}\)"


def commands() -> dict[str, list[str]]:
    """The arguments of each command of results/README.md, by its --out."""
    text = (ROOT / "results" / "README.md").read_text().replace("\\\n", " ")
    found = [shlex.split(line) for line in text.splitlines() if line.startswith("scene-experts reproduce")]
    return {words[words.index("--out") + 1]: words[1:] for words in found}


PAGES = (
    "confirmation",
    "ablation",
    "switches",
    "earlier",
    "short",
    "seeds",
    "parts",
    "parts/fox",
    "suite",
    "long",
    "long/fox",
    "long/bonsai",
    "extras",
)


@pytest.mark.parametrize("folder", PAGES)
def test_pages_are_what_their_commands_write(folder, tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")

    def no_picture(figure, path: Path) -> list[Path]:
        figures.discard(figure)
        return [path.with_suffix(".png")]

    monkeypatch.setattr(figures, "save", no_picture)
    monkeypatch.setattr(store, "load", lambda place: records(RECORDS))
    page, out = ROOT / "results" / folder, tmp_path / "out"
    out.mkdir()
    for strip in page.glob("fig5_*"):
        (out / strip.name).touch()
    args = commands()[f"results/{folder}"]
    args = [word.replace("CAPTURES", str(tmp_path)).replace("RUNS", str(tmp_path)).replace(f"results/{folder}", str(out)) for word in args]
    for word in args:
        if word.startswith(f"{tmp_path}/") and word != str(out):
            Path(word).mkdir()
    assert cli.main([*args, "--tables-only"]) == 0
    for path in sorted(path for path in page.iterdir() if path.suffix in (".md", ".csv", ".tex")):
        assert (out / path.name).read_text() == path.read_text(), path


def test_every_record_is_of_the_code_as_it_is():
    """A new setting must not change the names of the runs that have its default: they would be trained again."""
    keys = [run["key"] for path in sorted(RECORDS.glob("*.json")) for run in json.loads(path.read_text())["runs"]]
    assert len(keys) > 390 and sorted(keys) == sorted(record.key for record in records(RECORDS))


def test_a_record_takes_at_most_12_kb():
    assert max(len(line) for path in RECORDS.glob("*.json") for line in path.read_text().splitlines()) <= 12_000


@pytest.mark.parametrize("place", ["/root/", "/home/", "/work/", "/tmp/", "/Users/"])
def test_no_record_names_a_place_of_the_machine_that_made_it(place):
    assert [path for path in RECORDS.glob("*.json") if place in path.read_text()] == []


def test_when_experts_pay():
    spec = importlib.util.spec_from_file_location("experts_pay", ROOT / "benchmarks" / "experts_pay.py")
    script = importlib.util.module_from_spec(spec)  # type: ignore[arg-type]
    sys.modules["experts_pay"] = script  # dataclasses look their module up
    spec.loader.exec_module(script)  # type: ignore[union-attr]
    assert "\n".join(script.table(script.read_scores(RECORDS))) in (ROOT / "results" / "experts-pay.md").read_text()


def test_every_figure_of_the_summary_stands_with_its_evidence():
    number = re.compile(r"(?<![\w.])\d+\.\d+")
    evidence = {figure for page in (ROOT / "results").rglob("*.md") for figure in number.findall(page.read_text())}
    figures_of_the_summary = set(number.findall((ROOT / SUMMARY).read_text()))
    assert len(figures_of_the_summary) > 80 and not figures_of_the_summary - evidence


def test_the_size_of_files_in_the_readme_is_that_of_the_curve():
    rows = json.loads((ROOT / "results/size-curve.json").read_text())
    fern = [row for row in rows if row["capture"] == "fern"]
    (ours,) = (row for row in fern if row["rate"] == 0.002 and row["quality"] == 0.2)
    best = max((row for row in fern if row["format"] == "sog"), key=lambda row: row["psnr"])
    small, gain, large = f"{ours['bytes'] / 1e6:.2f} MB", f"{ours['psnr'] - best['psnr']:.1f} dB", f"{best['bytes'] / 1e6:.1f} MB"
    assert f"fern takes {small} with `--rate 0.002` and has {gain} more PSNR than {large} of 3DGS-MCMC as `sog`" in prose("README.md")
