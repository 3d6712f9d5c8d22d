"""Charts: points lie where the axes say. Without data, nothing is drawn."""

import itertools
import math
import re

import pytest

from scene_experts.report.chart import (
    BOTTOM,
    HEIGHT,
    LEFT,
    MOST,
    RIGHT,
    TOP,
    WIDTH,
    Line,
    bars,
    label,
    lines,
    log_ticks,
    smooth,
    text_on,
    thin_out,
    ticks,
)


def points(svg):
    return [tuple(map(float, p.split(","))) for p in re.search(r'points="([^"]+)"', svg)[1].split()]  # type: ignore[index]


def test_the_ends_of_a_line_are_at_the_ends_of_the_axes():
    found = points(lines("PSNR", [Line("a", [(0, 10.0), (50, 20.0), (100, 30.0)])], "dB"))
    assert found[0][0] == LEFT and found[-1][0] == WIDTH - RIGHT
    assert TOP < found[-1][1] < found[1][1] < found[0][1] < HEIGHT - BOTTOM
    assert found[1] == (pytest.approx((LEFT + WIDTH - RIGHT) / 2), pytest.approx((found[0][1] + found[2][1]) / 2, abs=0.1))


def test_a_log_axis_is_straight_for_powers():
    ys = [y for _, y in points(lines("loss", [Line("a", [(i, 10.0**-i) for i in range(4)])], log=True))]
    assert [b - a for a, b in itertools.pairwise(ys)] == pytest.approx([ys[1] - ys[0]] * 3, abs=0.2)


def test_nothing_to_draw_is_nothing():
    assert (
        lines("x", []) == "" and lines("x", [Line("a", [(1, 1.0)])]) == "" and lines("x", [Line("a", [(1, float("nan")), (2, 1.0)])]) == ""
    )
    assert "nan" not in lines("x", [Line("a", [(1, 1.0), (2, float("inf")), (3, 1.0)])])


def test_names_are_escaped_and_a_legend_is_only_for_several():
    one = [(0, 1.0), (1, 2.0)]
    assert "<b>" not in lines("<b>", [Line("<i>", one)]) and "legend" not in lines("t", [Line("a", one)])
    assert "legend" in lines("t", [Line("a", one), Line("b", one)])


def test_thinning_keeps_means_and_smoothing_lags():
    many = [(float(i), float(i)) for i in range(4000)]
    assert len(thin_out(many)) == MOST and sum(y for _, y in thin_out(many)) / MOST == pytest.approx(1999.5)
    assert smooth([(0, 0.0), (1, 2.0), (2, 4.0)], window=2) == [(0, 0.0), (1, 1.0), (2, 3.0)]
    assert smooth([(0, 0.0), (1, float("nan")), (2, 4.0)], window=2) == [(0, 0.0), (2, 2.0)]  # the rest of the line stays


def test_ticks_are_round():
    assert ticks(0, 10) == [0, 2, 4, 6, 8, 10] and ticks(0.03, 0.09) == pytest.approx([0.04, 0.06, 0.08])
    assert [label(v) for v in (0.05, 2e-5, 7000, 30_000, 2_500_000)] == ["0.05", "2e-5", "7000", "30k", "2.5M"]
    assert [10**v for v in log_ticks(-2.2, -0.9)] == pytest.approx([0.01, 0.02, 0.05, 0.1])
    assert len(log_ticks(-9, 3)) <= 7


def test_bars_are_as_wide_as_the_shares():
    assert re.findall(r"width:([\d.]+)%", bars("cov", [0.5, 0.3, 0.2])) == ["50.00", "30.00", "20.00"]


@pytest.mark.parametrize("last", [4000, 7000, 30_000, 12_500, 2_500_000])
def test_no_label_is_cut_at_the_edge(last):
    drawn = re.findall(r'<text x="([\d.]+)" y="\d+" text-anchor="middle">([^<]+)</text>', lines("a", [Line("a", [(0, 1.0), (last, 2.0)])]))
    assert len(drawn) > 2 and all(float(x) + 3.6 * len(text) <= WIDTH for x, text in drawn)  # 11 px letters are at most 7 px wide


def test_text_has_contrast_on_every_colour():
    assert text_on("#0072b2") == "#fff" and text_on("#e69f00") == "#000"


@pytest.mark.parametrize(("low", "high"), [(0.12, 0.19), (0.028, 0.048), (2.1, 4.9), (1.0, 1.001)])
def test_a_log_axis_has_numbers_in_a_short_range_too(low, high):
    found = log_ticks(math.log10(low), math.log10(high))
    assert len(found) >= 2 and all(math.log10(low) - 1e-9 <= value <= math.log10(high) + 1e-9 for value in found)
