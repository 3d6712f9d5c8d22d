"""Write the tables and figures of experiments, the checklist of claims, and a page that links to
them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from scene_experts.core.errors import InputError, few
from scene_experts.core.fields import flag_of
from scene_experts.core.io import write_bytes
from scene_experts.core.plain import MOST_DIFFERENCES, differences, to_json
from scene_experts.data import capture as captures
from scene_experts.evaluate import pictures
from scene_experts.evaluate.experts import draw_expert_strip
from scene_experts.evaluate.tables import ResultTable
from scene_experts.render import choose
from scene_experts.reproduce import claims, figures, store, tables
from scene_experts.reproduce.compare import COMPARE, make_difference_tables
from scene_experts.reproduce.experiments import Experiment
from scene_experts.reproduce.plan import OWN, CaptureSpec, Spec, code_of
from scene_experts.reproduce.statistics import SEED_SD, SEED_WEIGHT, on_common_scenes
from scene_experts.reproduce.store import Record
from scene_experts.training import run_folder
from scene_experts.training.background import with_background
from scene_experts.training.config import SCHEDULE
from scene_experts.training.nearest import with_near_plane

SHORT = 2000  # iterations; shorter trainings hardly pass the dense warm-up
DISJOINT = "No scene has runs of every row: each mean is over the scenes of its own row, so do not compare these rows."


def write(
    out: Path, experiments: Sequence[Experiment], scenes: Sequence[CaptureSpec], records: Sequence[Record], command: str = ""
) -> list[Path]:
    """Write the files of experiments below `out` and return their paths. Ignores records of other
    scenes. The page quotes `command`."""
    wanted = {scene.name for scene in scenes}
    records = [r for r in records if r.scene in wanted]
    written: list[Path] = []
    page = ["# Reproduced tables and figures", "", *(["```sh", command, "```", ""] if command else [])]
    if "CAPTURES/" in command:
        page += ["`CAPTURES` is the folder of the captures. `--out` and other folders are left out.", ""]
    for experiment in experiments:
        made = [*write_tables(out, experiment, scenes, records), *write_figures(out, experiment, scenes, records)]
        if experiment.name == "fig5":
            made += [p for s in scenes if (p := strip_path(out, s.name)).is_file()]
        written += made
        page += [f"## {experiment.title}", "", ", ".join(f"[{p.name}]({p.name})" for p in made) or "No run is finished yet.", ""]
        page += [f"![{p.stem}]({p.name})\n" for p in made if p.suffix == ".png"]
        if experiment.name == COMPARE:
            page += [line for p in made if p.suffix == ".md" for line in below_title(p.read_text())]
    claimed = any(experiment.name != COMPARE for experiment in experiments)
    if claimed:
        page += ["## The paper's claims", "", *caveat(records), claims.to_markdown(claims.check(records))]
    noise = f"{SEED_SD['psnr']} dB (SSIM {SEED_SD['ssim']}, LPIPS (3DGS) {SEED_SD['lpips_3dgs']}) with {SEED_WEIGHT} degrees of freedom"
    page += [
        "Differences are paired by view and seed. The interval covers other views and other seeds of these captures (Student's t).",
        "The interval over capture means covers other captures: Student's t with the captures as the sample, from three captures on."
        + (" Verdicts use the first interval, so they are about these captures." if claimed else ""),
        f"The standard deviation over seeds is the same for all captures. It is pooled from the measured seeds and from {noise}.",
    ]
    if claimed:
        page.append(
            '"On training views" is the difference in PSNR on training views over the second half of the trainings, paired by iteration.'
        )
    page.append("")
    path = out / "README.md"
    write_bytes(path, "\n".join(page).encode())
    return [*written, path]


def below_title(text: str) -> list[str]:
    """Return the lines of a Markdown page without its title, with headings one level lower."""
    return [f"#{line}" if line.startswith("#") else line for line in text.splitlines() if not line.startswith("# ")]


def caveat(records: Sequence[Record]) -> list[str]:
    """Return the caveat for verdicts from trainings that are shorter than the paper's; empty for
    full-length ones."""
    usual = [r for r in records if r.config.train.schedule == SCHEDULE] or records  # that of Octree-GS is longer
    length = max((r.config.train.iterations for r in usual), default=SCHEDULE)
    if length >= SCHEDULE:
        return []
    counts = {tables.densifications(r.config.train) for r in records if r.config.train.iterations == length}
    made = tables.count_range(counts)
    meaning = "An undecided or contradicted claim may hold in longer trainings."
    if length < SHORT:
        meaning = "Too little is learnt by then: **these verdicts say nothing about the paper**."
    steps = f" with {made} densification steps" if made else ""
    size = f"{length:,} iterations{steps}, not {SCHEDULE:,} with 134 (Scaffold-GS)"
    return [f"The verdicts are from trainings of {size}. {meaning}", ""]


def write_tables(out: Path, experiment: Experiment, scenes: Sequence[CaptureSpec], records: Sequence[Record]) -> list[Path]:
    """Write an experiment's tables: means for each data set, and the first column scene by
    scene."""
    made: dict[str, ResultTable] = {}
    datasets = list(dict.fromkeys(s.dataset for s in scenes if s.dataset == OWN or s.dataset in experiment.datasets))
    for dataset in datasets:
        allowed = None if dataset == OWN else experiment.scenes_of(dataset)
        names = [s.name for s in scenes if s.dataset == dataset and (allowed is None or s.name in allowed)]
        done = [name for name in names if any(r.scene == name and r.recipe in experiment.rows.values() for r in records)]
        if done:
            here = [r for r in records if r.scene in done]
            every = {r.scene for r in on_common_scenes(here, experiment.rows.values())}
            even = [name for name in done if name in every] or done
            table = tables.by_dataset(experiment, records, dataset, even)
            if even != done:
                missed = ", ".join(name for name in done if name not in even)
                table = replace(table, notes=(*table.notes, f"Not in the means, as not every row has a run there: {missed}."))
            elif len(done) > 1 and not every:
                table = replace(table, notes=(*table.notes, DISJOINT))
            made[f"{dataset}: means over {', '.join(even)}"] = table
            made[f"{dataset}: scene by scene"] = tables.by_scene(experiment, records, done)
            made |= {f"{dataset}: {name}": table for name, table in make_difference_tables(experiment, records, done).items()}
        if experiment.name == "fig3":
            shares = {name: found for name in done if (found := tables.expert_shares(experiment, records, name))}
            made |= {f"{name}: share of the assignments at the end, %": found for name, found in shares.items()}
    out_paths = []
    for ending, text in tables.write_all(experiment.title, made).items() if made else ():
        path = out / f"{experiment.name}.{ending}"
        write_bytes(path, text.encode())
        out_paths.append(path)
    return out_paths


def write_figures(out: Path, experiment: Experiment, scenes: Sequence[CaptureSpec], records: Sequence[Record]) -> list[Path]:
    """Write the charts of a figure; nothing for a table, or where no run is finished."""
    names = [s.name for s in scenes]
    if experiment.name == "fig1b":
        return figures.relative_psnr(experiment, records, names, out / "fig1b")
    if experiment.name == "fig3":
        drawn = [(name, attribute) for name in names for attribute in ("cov", "opacity", "color")]  # the paper shows cov
        places = {pair: f"fig3_{pair[0]}{'' if pair[1] == 'cov' else '_' + pair[1]}" for pair in drawn}
        return [path for (name, a), place in places.items() for path in figures.expert_shares(experiment, records, name, out / place, a)]
    if experiment.name == "fig6":
        return figures.cost(experiment, records, out / "fig6")
    if experiment.name == "fig7":
        return figures.layers(experiment, records, out / "fig7")
    return []


def strip_path(out: Path, scene: str) -> Path:
    """Return the path of the picture of `draw_experts`."""
    return out / f"fig5_{scene}.png"


def draw_experts(spec: Spec, run: Path, out: Path, attribute: str = "color") -> Path:
    """Draw Figure 5 of a run: the first held-out view, then the anchors of each expert alone.
    Returns `strip_path`."""
    opened = run_folder.open_run(run)
    capture = captures.load(replace(opened.config.data, path=spec.scene.path), spec.seed)
    try:
        index = (capture.test or capture.train)[0]
        rasterize = choose("auto", "cpu", antialias=opened.config.train.antialias)
        background = torch.tensor(capture.background)
        sheet = draw_expert_strip(opened.scene, capture.views[index].camera, opened.step, rasterize, background, attribute)
    finally:
        capture.images.close()
    path = strip_path(out, spec.scene.name)
    pictures.write_picture(path, sheet)
    return path


def adopt(run: Path, wanted: Sequence[Spec]) -> Record:
    """Return the record of a run folder that another command trained. Its scene is the name of its
    capture.

    Raises InputError unless it is one of the `wanted` runs, and for a background or a near plane that
    are not those of the recipe: records take them for those.
    """
    config = run_folder.read_config(run)
    train, data = config.train, config.data
    if train.mean_background or train.near_share:
        asked = replace(data, background=None if train.mean_background else data.background, near=None if train.near_share else data.near)
        capture = captures.load(asked, train.seed)
        found, _ = with_near_plane(*with_background(replace(config, data=asked), capture))
        capture.images.close()
        for name in ("background", "near"):
            right, other = getattr(found.data, name), getattr(data, name)
            if right != other:
                expected = f"the {name} that the recipe has on this capture, {right}"
                raise InputError(f"expected {expected}, found {other} in {run}; train it without {flag_of(name)}")
    found = store.read_run(run, captures.name_capture(Path(config.data.path)), code_of(config.train))
    if all(store.find([found], spec) is None for spec in wanted):
        other = describe_other(found, wanted)
        raise InputError(f"expected --adopt with a run that this command asks for, found {other} in {run}; leave it out")
    return found


def describe_other(found: Record, wanted: Sequence[Spec]) -> str:
    """Return what a record is, and in what it differs from the wanted run of its recipe, capture and
    seed, if there is one."""
    alike = [spec for spec in wanted if (spec.scene.name, spec.train.recipe, spec.seed) == (found.scene, found.recipe, found.seed)]
    if not alike:
        return f"{found.recipe} on {found.scene}, seed {found.seed},"
    pairs = ((found.config.train, found.config.data), (alike[0].train, alike[0].data))
    own, asked = ({**to_json(train), "data": to_json(replace(data, path=Path()))} for train, data in pairs)
    other = few(differences(own, asked), MOST_DIFFERENCES) or "code of another package"
    return f"{alike[0].label} with other settings than are asked for ({other})"
