"""The folder of an evaluated run with invented scores."""

import json
from dataclasses import replace

from PIL import Image

from scene_experts.core.io import write_json
from scene_experts.core.plain import to_json
from support.records import record


def make_run(folder, recipe="moe-gs", pictures=True):
    """Write an evaluated run of three test views to `folder`; the last line of its metrics is torn."""
    made = record(recipe, views=3)
    config = replace(made.config, command=f"scene-experts train {recipe} --data <here> --out run")
    write_json(folder / "config.json", {"format": 1, **to_json(config)})
    results = {**made.results, "capture": "fox", "views": "test", "view_count": 3, "split": "mod8", "resolution": "as-is", "step": 3000}
    write_json(folder / "results.json", results)
    write_json(folder / "per_view.json", {name: {"file": name, **facts} for name, facts in made.per_view.items()})
    lines = [
        {"step": s, "psnr": 20 + s / 10, "terms": {"l1": 0.1}, "anchors": 5, "active": 0.5, "gaussians": 9, "seconds": s} for s in range(9)
    ]
    lines += [{"step": 9, "grown": 3, "pruned": 1, "anchors": 7}]
    lines += [{**lines[5], "step": 10 + s, "routing": {"cov": [0.6, 0.4]}, "entropy": {"cov": 0.9}} for s in range(3)]
    (folder / "metrics.jsonl").write_text("\n".join(map(json.dumps, lines)) + '\n{"torn')
    if pictures:
        for kind, colour in (("gt", "red"), ("renders", "blue"), ("errors", "black")):
            (folder / "test" / kind).mkdir(parents=True)
            for name in made.per_view:
                Image.new("RGB", (1200, 600), colour).save(folder / "test" / kind / name)
    return folder
