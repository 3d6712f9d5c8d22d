"""Which held-out views the page shows, and their order."""

import json

from scene_experts.core.io import write_json
from scene_experts.report.source import read_run
from scene_experts.report.views import MOST_VIEWS, choose_shown, show_views
from support.evaluated import make_run


def test_the_best_and_the_worst_view_come_first(tmp_path):
    folder = make_run(tmp_path)
    per_view = json.loads((folder / "per_view.json").read_text())
    for name, psnr in zip(per_view, (21.0, 19.0, 25.0)):
        per_view[name]["psnr"] = psnr
    write_json(folder / "per_view.json", per_view)
    names = list(per_view)
    source = read_run(folder)
    assert choose_shown([source], names) == [(names[2], "best view"), (names[1], "worst view"), (names[0], "")]
    assert choose_shown([source], names[:1]) == [(names[0], "")]
    html, pictures = show_views([source], "0.")
    assert html.index("best view") < html.index("worst view") < html.index(names[0]) and len(pictures) == 9


def test_many_views_are_thinned_out(tmp_path):
    source = read_run(make_run(tmp_path))
    facts = next(iter(source.per_view.values()))
    source.per_view.update({f"{i:03d}": {**facts, "psnr": 20 + i / 100} for i in range(100)})
    shown = choose_shown([source], [f"{i:03d}" for i in range(100)])
    assert [name for name, _ in shown[:2]] == ["099", "000"] and len(shown) <= MOST_VIEWS
