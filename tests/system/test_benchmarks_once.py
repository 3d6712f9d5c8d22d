"""benchmarks/quality.py and blocks.py do not make again what is there, and take nothing for it that other options made."""

import json
import shlex
from pathlib import Path

import pytest

import blocks
import quality
from scene_experts.core.io import write_json


def test_a_run_with_other_options_is_not_taken_for_the_one_that_is_asked_for(tmp_path, monkeypatch):
    commands = []

    def run(args):
        commands.append(args[0])
        folder = Path(args[args.index("--out") + 1]) if args[0] == "train" else Path(args[1])
        if args[0] == "train":
            write_json(folder / "config.json", {"command": shlex.join(["scene-experts", *args])})
        else:
            write_json(folder / "results.json", {"psnr": 30.0})

    monkeypatch.setattr(quality, "run", run)
    for _ in range(2):
        assert quality.run_one(Path("fox"), "moe-gs", 0, 3000, tmp_path / "run", []) == {"psnr": 30.0}
    assert commands == ["train", "eval"]
    for iterations, extra in ((7000, []), (3000, ["--scene.hidden", "16"])):
        with pytest.raises(SystemExit, match=r"--iterations 3000.*give another --out"):
            quality.run_one(Path("fox"), "moe-gs", 0, iterations, tmp_path / "run", extra)


def test_a_step_of_a_comparison_in_blocks_is_that_of_the_same_command(tmp_path):
    done = {"command": "train moe-gs --seed 0 --out whole --resume", "cpu_seconds": 1.0, "gib": 0.1}
    (tmp_path / "whole.json").write_text(json.dumps(done))
    blocks.run(tmp_path, "whole", ["train", "moe-gs", "--seed", "0", "--out", "whole"])
    with pytest.raises(SystemExit, match=r"--seed 1.*found.*--seed 0.*give another --out"):
        blocks.run(tmp_path, "whole", ["train", "moe-gs", "--seed", "1", "--out", "whole"])
