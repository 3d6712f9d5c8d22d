"""Tables: ours beside the paper's, spreads, best cells, notes; LaTeX that escapes."""

from scene_experts.reproduce.experiments import EXPERIMENTS
from scene_experts.reproduce.tables import (
    COLUMNS,
    by_dataset,
    by_scene,
    count_range,
    escape,
    expert_shares,
    notes,
    paper_numbers,
    to_latex,
    write_all,
)
from support.records import record

TABLE4, TABLE3 = EXPERIMENTS["table4"], EXPERIMENTS["table3"]


def runs():
    out = [record("moe-gs", "truck", seed, psnr=24 + seed, views=1, iterations=30_000) for seed in (0, 1)]
    return [*out, record("scaffold-gs-opacity", "truck", 0, psnr=23.0, views=1, mb=8.0)]


def test_a_note_names_the_captures_that_a_seed_lacks():
    whole = [record("moe-gs", scene, seed, psnr=24.0, views=1) for scene in ("train", "truck") for seed in (0, 1)]
    fewer = [r for r in whole if (r.scene, r.seed) != ("truck", 1)]
    assert "other: no run with seed 1 on truck." in notes({"moe-gs": whole, "other": fewer})
    assert not any("no run" in note for note in notes({"moe-gs": whole, "other": whole}))


def test_ours_stand_beside_the_papers():
    table = by_dataset(TABLE4, runs(), "TanksAndTemples", ["truck"])
    assert table.titles[:5] == ("", "PSNR", "SSIM", "LPIPS (3DGS)", "MB") and table.titles[5] == "PSNR (paper)"
    rows = {row[0]: row for row in table.rows}
    assert rows["MoE-GS"][1] == "24.50 ± 0.71" and rows["MoE-GS"][5] == "24.61"
    assert rows["w/o MoE"][1] == "23.00" and rows["w/o CL"][1] == "-" and rows["w/o CL"][5] == "24.42"
    assert not table.best  # means over other seeds are no rivals
    assert "w/o MoE: no run with seed 1." in table.notes
    table = by_dataset(TABLE4, [r for r in runs() if r.seed == 0], "TanksAndTemples", ["truck"])
    assert (list(rows).index("MoE-GS"), 1) in table.best and (list(rows).index("w/o MoE"), 4) in table.best
    table = by_dataset(TABLE4, runs(), "TanksAndTemples", ["truck"])
    assert any(note.startswith("No run: w/o CL") for note in table.notes) and all(
        fact in table.notes[0] for fact in ("3,000", "13", "30,000", "134")
    )


def test_own_captures_have_no_published_numbers():
    assert paper_numbers(TABLE4, "captures") == {}
    assert len(by_dataset(TABLE4, runs(), "captures", ["truck"]).titles) == 5


def test_table_3_is_of_one_column():
    assert paper_numbers(TABLE3, "DeepBlending") == {"Scaffold-GS": [41.0], "Scaffold-GS+L_opacity": [70.5]}
    table = by_dataset(TABLE3, [record("scaffold-gs", "playroom", active=0.4)], "DeepBlending", ["playroom"])
    assert table.rows[0] == ("Scaffold-GS", "40.0", "41.0") and not table.best


def test_scene_by_scene():
    table = by_scene(TABLE4, runs(), ["truck", "train"])
    assert table.titles == ("PSNR", "truck", "train") and dict(zip([r[0] for r in table.rows], table.rows))["MoE-GS"][2] == "-"
    assert not table.best
    alike = by_scene(TABLE4, [r for r in runs() if r.seed == 0], ["truck", "train"])
    assert alike.best == {([r[0] for r in alike.rows].index("MoE-GS"), 1)}


def test_rows_that_read_alike_are_best_alike():
    scores = {"moe-gs": 24.001, "moe-gs-no-cl": 24.0, "moe-gs-no-load": 23.99}
    table = by_dataset(TABLE4, [record(recipe, "truck", psnr=psnr, views=1) for recipe, psnr in scores.items()], "captures", ["truck"])
    names = [row[0] for row in table.rows]
    assert {names[row] for row, column in table.best if column == 1} == {"MoE-GS", "w/o CL"}
    assert {names[row] for row, column in table.best if column == 4} == {"MoE-GS", "w/o CL", "w/o L_load"}  # 10.0 MB each


def test_the_three_files():
    table = by_dataset(TABLE4, runs(), "TanksAndTemples", ["truck"])
    files = write_all("Table 4", {"T&T": table})
    assert files["md"].startswith("# Table 4") and "| MoE-GS |" in files["md"].replace("**", "")
    assert files["csv"].splitlines()[0] == "table,row,column,value,spread"
    assert "T&T,w/o MoE,PSNR,23.00," in files["csv"] and "T&T,MoE-GS,PSNR,24.50,0.71" in files["csv"] and "w/o CL,PSNR," not in files["csv"]
    assert r"w/o L\_load" in to_latex(table, "T&T") and r"\caption{T\&T}" in to_latex(table, "T&T") and r"$\pm$" in files["tex"]
    assert escape("50 %") == r"50 \%" and escape("moe-gs --scene.F 8") == "moe-gs -{}-scene.F 8" and escape("$ ±") == r"\$ $\pm$"


def test_a_row_that_lacks_a_scene_is_no_rival():
    table = by_dataset(
        TABLE4, [*runs(), record("scaffold-gs-opacity", "train", 0, psnr=10.0, views=1)], "TanksAndTemples", ["truck", "train"]
    )
    assert (list(TABLE4.rows).index("MoE-GS"), 1) not in table.best and any("MoE-GS" in note and "train" in note for note in table.notes)


def test_a_mean_without_the_runs_that_lack_a_score_is_no_rival():
    scores = {"moe-gs": (0.25, None), "scaffold-gs-opacity": (0.2, 0.4)}
    made = [record(recipe, s, lpips_3dgs=v) for recipe, both in scores.items() for s, v in zip(("truck", "train"), both)]
    table = by_dataset(TABLE4, made, "captures", ["truck", "train"])
    assert dict(zip((row[0] for row in table.rows), table.rows))["MoE-GS"][3] == "0.250"
    assert {column for _, column in table.best} == {1, 2, 4} and "MoE-GS: no LPIPS (3DGS) of train (seed 0)." in table.notes
    whole = by_dataset(TABLE4, [r for r in made if r.scene == "truck"], "captures", ["truck"])
    assert {column for _, column in whole.best} == {1, 2, 3, 4} and not any("no LPIPS" in note for note in whole.notes)


def test_notes_say_which_seeds_each_mean_is_of():
    pair = [record("moe-gs", s, seed, psnr=24.0 + seed) for s in ("truck", "train") for seed in (0, 1)]
    lacking = [record("scaffold-gs-opacity", s, seed) for s, seed in (("truck", 0), ("truck", 1), ("train", 0))]
    found = by_dataset(TABLE4, [*pair, *lacking], "TanksAndTemples", ["truck", "train"]).notes
    assert any("w/o MoE" in note for note in found) and not any("MoE-GS" in note for note in found)


def test_shares_of_experts_at_the_end():
    experts = {"cov": {"share": [0.5, 0.3, 0.2], "per_anchor": [1.0, 0.6, 0.4], "mean_gate": [0.4, 0.3, 0.3], "entropy": 0.5}}
    table = expert_shares(EXPERIMENTS["fig3"], [record("moe-gs-e3-top2", seed=1), record("moe-gs-e3-top2", experts=experts)], "fox")
    assert table is not None and table.rows == (("with L_load: cov", "50.0", "30.0", "20.0", "100.0", "60.0", "40.0", "0.50"),)
    assert table.titles[3:5] == ("expert 3", "expert 1, of anchors")
    dense = {"cov": {"share": None, "per_anchor": None, "mean_gate": [0.5, 0.5], "entropy": 1.0}}
    assert expert_shares(EXPERIMENTS["fig3"], [record("moe-gs-e3-top2", experts=dense)], "fox") is None


def test_training_times_are_cpu_time_where_every_record_has_it():
    rows = [f"moe-gs-e{n}-top1" for n in (2, 3)]
    old = record(rows[0], seconds=100.0)
    new = [record(row, seconds=90.0, cpu_seconds=150.0, load={"cores": 2, "start": 0.4, "end": 1.9}) for row in rows]
    cpu, wall = (by_dataset(EXPERIMENTS["fig6"], runs, "captures", ["fox"]) for runs in (new, [old, new[1]]))
    assert cpu.titles[2] == COLUMNS["cpu_seconds"].title and cpu.rows[0][2] == "150"
    assert any("0.4" in note and "1.9" in note for note in cpu.notes)
    assert wall.titles[2] == COLUMNS["train_seconds"].title and wall.rows[0][2] == "100"
    assert any("wall times" in note for note in wall.notes) and not any("load average" in note for note in wall.notes)


def test_table_1_has_the_cpu_time_beside_the_paper_s_columns_where_every_record_has_it():
    table1 = EXPERIMENTS["table1"]
    new = [record("moe-gs", "truck", cpu_seconds=150.0), record("scaffold-gs", "truck", cpu_seconds=90.0)]
    table = by_dataset(table1, new, "TanksAndTemples", ["truck"])
    assert table.titles[5:7] == ("training, CPU s", "PSNR (paper)") and len(table.rows[0]) == len(table.titles)
    assert table.rows[list(table1.rows).index("MoE-GS")][5] == "150"
    assert "training, CPU s" not in by_dataset(table1, [*new, record("3dgs", "truck")], "TanksAndTemples", ["truck"]).titles


def test_a_growth_rule_that_does_not_say_how_often_it_acts():
    assert count_range([17, None, 13]) == "13 to 17" and count_range([13]) == "13" and count_range([None]) == ""
