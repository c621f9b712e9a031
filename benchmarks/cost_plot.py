"""A plot of milliseconds over sizes, as SVG without a plotting library."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from xml.sax.saxutils import escape

WIDTH, HEIGHT = 640, 400
LEFT, RIGHT, TOP, BOTTOM = 72, 24, 48, 56
COLORS = ("#1f6fb2", "#c2571a", "#3b8a4a", "#7a4ea3")
"""Of the curves, legible on white and apart in grey."""
INK, FAINT = "#222222", "#dddddd"
STEPS = 5


def plot(curves: Mapping[str, Sequence[tuple[float, float]]], title: str, x_label: str) -> str:
    """Return an SVG of curves by name, each of points (size, ms), with a legend and axes from 0."""
    x_most = max(x for points in curves.values() for x, _ in points)
    y_most = _round_up(max(y for points in curves.values() for _, y in points))

    def at(x: float, y: float) -> tuple[float, float]:
        return LEFT + x / x_most * (WIDTH - LEFT - RIGHT), HEIGHT - BOTTOM - y / y_most * (HEIGHT - TOP - BOTTOM)

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}" '
        f'font-family="sans-serif" font-size="13" fill="{INK}">',
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>',
        _text(WIDTH / 2, 24, title, "middle", 15),
        _text((LEFT + WIDTH - RIGHT) / 2, HEIGHT - 14, x_label, "middle"),
    ]
    for k in range(STEPS + 1):
        (x0, y0), (x1, _) = at(0, y_most * k / STEPS), at(x_most, 0)
        parts += [
            _line(x0, y0, x1, y0, FAINT if k else INK),
            _text(x0 - 8, y0 + 4, f"{y_most * k / STEPS:g} ms", "end"),
        ]
    for x in sorted({x for points in curves.values() for x, _ in points}):
        parts.append(_text(at(x, 0)[0], at(x, 0)[1] + 20, f"{x:,.0f}", "middle"))
    for i, (name, points) in enumerate(curves.items()):
        color = COLORS[i % len(COLORS)]
        spots = [at(x, y) for x, y in points]
        line = " ".join(f"{x:.1f},{y:.1f}" for x, y in spots)
        parts.append(f'<polyline points="{line}" fill="none" stroke="{color}" stroke-width="2"/>')
        parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{color}"/>' for x, y in spots]
        y = TOP + 4 + 18 * i
        parts += [_line(LEFT + 12, y - 4, LEFT + 36, y - 4, color, 2.5), _text(LEFT + 44, y, name, "start")]
    return "\n".join([*parts, "</svg>", ""])


def _round_up(value: float) -> float:
    step = 10.0
    while value > STEPS * step:
        step *= 2 if f"{step:g}"[0] in "15" else 2.5
    return STEPS * step


def _line(x0: float, y0: float, x1: float, y1: float, color: str, width: float = 1) -> str:
    return f'<line x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}" stroke="{color}" stroke-width="{width:g}"/>'


def _text(x: float, y: float, words: str, anchor: str, size: int = 13) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" font-size="{size}">{escape(words)}</text>'
