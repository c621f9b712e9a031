"""A plot of rates over rates, as SVG without a plotting library."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from xml.sax.saxutils import escape

WIDTH, HEIGHT = 640, 400
LEFT, RIGHT, TOP, BOTTOM = 64, 24, 48, 56
COLORS = ("#1f6fb2", "#c2571a", "#3b8a4a", "#7a4ea3")
"""Of the curves, legible on white and apart in grey."""
INK, FAINT = "#222222", "#dddddd"
SHIFT_PX = 5.0
"""Between curves, so that their intervals do not cover one another."""


@dataclass(frozen=True)
class Curve:
    """One line: points (x, y, low, high), all 0..1, in the order of x."""

    name: str
    points: tuple[tuple[float, float, float, float], ...]


def plot(curves: Sequence[Curve], title: str, x_label: str, y_label: str = "success") -> str:
    """Return an SVG with a legend, percent on both axes and a bar for every interval."""
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}" '
        f'font-family="sans-serif" font-size="13" fill="{INK}">',
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>',
        _text(WIDTH / 2, 24, title, "middle", 15),
        _text((LEFT + WIDTH - RIGHT) / 2, HEIGHT - 14, x_label, "middle"),
        f'<g transform="translate(18 {_y(0.5):g}) rotate(-90)">{_text(0, 0, y_label, "middle")}</g>',
    ]
    for k in range(6):
        at = k / 5
        parts += [
            _line(_x(0), _y(at), _x(1), _y(at), FAINT),
            _text(LEFT - 10, _y(at) + 4, f"{100 * at:g} %", "end"),
            _line(_x(at), _y(0), _x(at), _y(0) + 5, INK),
            _text(_x(at), _y(0) + 20, f"{100 * at:g} %", "middle"),
        ]
    parts.append(_line(_x(0), _y(0), _x(1), _y(0), INK))
    for i, curve in enumerate(curves):
        parts += _drawn(curve, COLORS[i % len(COLORS)], (i - (len(curves) - 1) / 2) * SHIFT_PX)
        y = _y(0) - 18 * (len(curves) - i)
        parts += [_line(_x(1) - 96, y - 4, _x(1) - 72, y - 4, COLORS[i % len(COLORS)], 2.5),
                  _text(_x(1) - 64, y, curve.name, "start")]  # fmt: skip
    return "\n".join([*parts, "</svg>", ""])


def _drawn(curve: Curve, color: str, shift: float) -> list[str]:
    spots = [(_x(x) + shift, _y(y), _y(low), _y(high)) for x, y, low, high in curve.points]
    line = " ".join(f"{x:.1f},{y:.1f}" for x, y, _, _ in spots)
    parts = [f'<polyline points="{line}" fill="none" stroke="{color}" stroke-width="2"/>']
    for x, y, low, high in spots:
        parts += [
            _line(x, low, x, high, color),
            _line(x - 3, low, x + 3, low, color),
            _line(x - 3, high, x + 3, high, color),
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{color}"/>',
        ]
    return parts


def _x(rate: float) -> float:
    return LEFT + rate * (WIDTH - LEFT - RIGHT)


def _y(rate: float) -> float:
    return HEIGHT - BOTTOM - rate * (HEIGHT - TOP - BOTTOM)


def _line(x0: float, y0: float, x1: float, y1: float, color: str, width: float = 1) -> str:
    return f'<line x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}" stroke="{color}" stroke-width="{width:g}"/>'


def _text(x: float, y: float, words: str, anchor: str, size: int = 13) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" font-size="{size}">{escape(words)}</text>'
