"""The summary of a capture: its values against their plain definitions, and how it is printed."""

import io
import json
from dataclasses import replace

import pytest
import torch
from rich.console import Console

from scene_experts.data.summary import format_value, neighbour_distance, print_summary, summarise
from support.captures import load
from support.synthetic import make_capture, make_nerfstudio


def test_counts_sizes_and_a_capture_without_points(tmp_path):
    capture = load(make_capture(tmp_path, views=6, size=(48, 32), points=40).folder, split="first:2")
    said = summarise(capture)
    assert json.loads(json.dumps(said)) == said
    assert (said["views"], said["train"], said["test"], said["split"]) == (6, 4, 2, "first:2")
    assert said["sizes"] == {"48x32": 2, "40x36": 2, "32x48": 2} and said["undistorted"] == 0 and said["masks"] == 0
    assert said["decoded_bytes"] == 3 * 2 * (48 * 32 + 40 * 36 + 32 * 48)
    assert said["near"] == capture.views[0].camera.near and said["world"]["scale"] == capture.world.scale
    bare = summarise(replace(capture, points=None))
    assert bare["points"] == 0 and bare["median_neighbour_distance"] is None
    capture.images.close()


def test_the_neighbour_distance_is_the_median_of_the_nearest_even_far_from_the_origin():
    grid = torch.cartesian_prod(*[torch.arange(6, dtype=torch.float64)] * 3) * 0.25 + 1e6
    assert neighbour_distance(grid) == 0.25 and abs(neighbour_distance(grid, exact=10) - 0.25) < 1e-5


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (True, "yes"),
        (False, "no"),
        (1234567, "1,234,567"),
        (0.1 + 0.2, "0.3"),
        ({"48x32": 4, "40x36": 3}, "48x32 4, 40x36 3"),
        ([0.0, 1.5], "0, 1.5"),
        ("mod8", "mod8"),
        (None, "None"),
    ],
)
def test_values_are_formatted_for_a_reader(value, said):
    assert format_value(value) == said


def test_one_fact_a_row_then_the_warnings_on_one_line_each(tmp_path):
    out = io.StringIO()
    long = "a warning " * 30
    capture = load(make_capture(tmp_path, views=6, size=(48, 32), points=40).folder)
    print_summary(replace(capture, warnings=(long,)), Console(file=out, width=60))
    rows = out.getvalue().splitlines()
    assert ["views", "6"] in [row.split() for row in rows] and rows[-1] == f"warning: {long}"
    assert not any(row.startswith("warnings") for row in rows)
    capture.images.close()


def test_names_in_a_capture_neither_steer_the_terminal_nor_fail_as_markup(tmp_path):
    folder = make_nerfstudio(tmp_path, views=4, size=(48, 32), points=40).folder
    meta = json.loads((folder / "transforms.json").read_text())
    meta["frames"][0]["file_path"] = "images/[/red]\x1b]0;title\x07\ud800.png"
    (folder / "transforms.json").write_text(json.dumps(meta))
    out = io.StringIO()
    capture = load(folder)
    print_summary(replace(capture, name="[/red]\x1b[2J"), Console(file=out, width=200))
    assert "\x1b" not in out.getvalue() and "\ud800" not in out.getvalue() and out.getvalue().count("[/red]") == 2
    capture.images.close()
