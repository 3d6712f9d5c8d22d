"""Line charts and share bars as small inline SVG."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f", "#b8a800")
WIDTH, HEIGHT, LEFT, BOTTOM, TOP, RIGHT = 420, 230, 52, 30, 10, 20
MOST = 400  # the most points of a line


@dataclass(frozen=True)
class Line:
    """A named series of (x, y)."""

    name: str
    points: Sequence[tuple[float, float]]


def lines(title: str, series: Sequence[Line], unit: str = "", log: bool = False) -> str:
    """Draw several lines over the iterations; empty where no line has two finite points. `log`: a
    logarithmic y axis."""
    shown = []
    for line in series:
        points = [(x, y) for x, y in line.points if math.isfinite(x) and math.isfinite(y) and (y > 0 or not log)]
        if len(points) > 1:
            shown.append(Line(line.name, thin_out(points)))
    if not shown:
        return ""
    xs = [x for line in shown for x, _ in line.points]
    ys = [math.log10(y) if log else y for line in shown for _, y in line.points]
    x0, x1 = min(xs), max(xs)
    y0, y1 = add_margin(min(ys), max(ys))
    to_x = lambda x: LEFT + (x - x0) / max(x1 - x0, 1e-12) * (WIDTH - LEFT - RIGHT)  # noqa: E731
    to_y = lambda y: HEIGHT - BOTTOM - (y - y0) / max(y1 - y0, 1e-12) * (HEIGHT - BOTTOM - TOP)  # noqa: E731
    parts = [f"<figure><figcaption>{escape(title)}{f', {escape(unit)}' if unit else ''}</figcaption>"]
    parts.append(f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title)}">')
    for y in log_ticks(y0, y1) if log else ticks(y0, y1):
        text = label(10**y if log else y)
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{to_y(y):.1f}" y2="{to_y(y):.1f}"/>')
        parts.append(f'<text x="{LEFT - 5}" y="{to_y(y) + 4:.1f}" text-anchor="end">{text}</text>')
    for x in ticks(x0, x1, 4):
        parts.append(f'<text x="{to_x(x):.1f}" y="{HEIGHT - 10}" text-anchor="middle">{label(x)}</text>')
    for i, line in enumerate(shown):
        path = " ".join(f"{to_x(x):.1f},{to_y(math.log10(y) if log else y):.1f}" for x, y in line.points)
        colour = COLOURS[i % len(COLOURS)]
        parts.append(
            f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="1.5"><title>{escape(line.name)}</title></polyline>'
        )
    parts.append("</svg>")
    if len(shown) > 1:
        parts.append(legend([line.name for line in shown]))
    return "".join([*parts, "</figure>"])


def legend(names: Sequence[str]) -> str:
    """Draw the names of lines beside their colours."""
    items = [f'<span><i style="background:{COLOURS[i % len(COLOURS)]}"></i>{escape(name)}</span>' for i, name in enumerate(names)]
    return f'<div class="legend">{"".join(items)}</div>'


def bars(title: str, shares: Sequence[float]) -> str:
    """Draw one bar, divided into shares that sum to 1, each with its percentage."""
    cells = []
    for i, share in enumerate(shares):
        colour = COLOURS[i % len(COLOURS)]
        style = f"width:{100 * share:.2f}%;background:{colour};color:{text_on(colour)}"
        cells.append(f'<span style="{style}" title="expert {i + 1}: {share:.1%}">{share:.0%}</span>')
    return f'<div class="bar"><b>{escape(title)}</b><div>{"".join(cells)}</div></div>'


def text_on(colour: str) -> str:
    """Return the colour of text on a background "#rrggbb": black or white, whichever has more
    contrast (WCAG 2)."""
    parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    r, g, b = (p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts)
    return "#000" if 0.2126 * r + 0.7152 * g + 0.0722 * b > 0.179 else "#fff"


def thin_out(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Reduce a line to MOST points: the means of MOST equal stretches."""
    if len(points) <= MOST:
        return list(points)
    out = []
    for i in range(MOST):
        part = points[i * len(points) // MOST : (i + 1) * len(points) // MOST]
        out.append((sum(x for x, _ in part) / len(part), sum(y for _, y in part) / len(part)))
    return out


def smooth(points: Sequence[tuple[float, float]], window: int = 15) -> list[tuple[float, float]]:
    """Return the running mean over `window` points, without values that are not finite. It hides
    the differences between views."""
    points, out, total = [(x, y) for x, y in points if math.isfinite(y)], [], 0.0
    for i, (x, y) in enumerate(points):
        total += y - (points[i - window][1] if i >= window else 0.0)
        out.append((x, total / min(i + 1, window)))
    return out


def add_margin(low: float, high: float) -> tuple[float, float]:
    """Widen a range by 5 % at both ends."""
    margin = 0.05 * (high - low) or max(abs(high), 1.0) * 0.05
    return low - margin, high + margin


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Return up to `count` + 1 round numbers between two ends."""
    span = max(high - low, 1e-12)
    step = 10 ** math.floor(math.log10(span / count))
    step *= next(m for m in (1, 2, 5, 10) if span / (step * m) <= count)
    first = math.ceil(low / step) * step
    return [first + i * step for i in range(int((high - first) / step) + 1)]


def log_ticks(low: float, high: float) -> list[float]:
    """Return logarithms of round numbers between two logarithms: 1, 2, 5 of each decade, or some
    decades if there are many; of evenly spaced ones where fewer than two of these lie there."""
    decades = range(math.floor(low), math.ceil(high) + 1)
    every = max(1, math.ceil(len(decades) / 6))
    factors = (1, 2, 5) if len(decades) <= 4 else (1,)
    found = [e + math.log10(m) for e in decades[::every] for m in factors]
    inside = [value for value in found if low <= value <= high]
    return inside if len(inside) > 1 else [math.log10(value) for value in ticks(10**low, 10**high) if value > 0]


def label(value: float) -> str:
    """Format a number of an axis."""
    if abs(value) >= 1_000_000:
        return f"{value / 1e6:g}M"
    if 0 < abs(value) < 1e-3:
        return f"{value:.0e}".replace("e-0", "e-")
    return f"{value / 1e3:g}k" if abs(value) >= 10_000 else f"{round(value, 10):.4g}"
