"""Plots of a benchmark as SVG: no library, colours from the style of the page that they stand in, or of their own.

A page that shows them defines the colours --s0 to --s7 of the series, --good, --bad, --line and --ink.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from xml.sax.saxutils import escape, quoteattr

from thinkgrasp.benchmark.statistics import Interval

WIDTH = 760
ROW = 30
LEFT, RIGHT, TOP, BOTTOM = 190, 30, 12, 46
MAX_NAME = 25
"""Letters that fit in front of a row."""
N_COLORS = 8
DASHES = ("", "7 4", "2 3", "9 3 2 3")
"""Of curves beyond the last colour."""
TICKS = 5


@dataclass(frozen=True)
class Bar:
    """A rate with its interval, 0..1."""

    name: str
    value: float
    interval: Interval | None


@dataclass(frozen=True)
class Curve:
    """One line: points (x, y, interval), all 0..1, in the order of x."""

    name: str
    points: tuple[tuple[float, float, Interval | None], ...]


def rates(bars: Sequence[Bar], title: str) -> str:
    """Return a dot with its interval per name, over 0 to 100 percent."""
    parts = _percent_axis(len(bars))
    for i, bar in enumerate(bars):
        y = TOP + ROW * (i + 0.5)
        parts.append(_row_name(y + 4, bar.name))
        if bar.interval is not None:
            low, high = (_across(max(0.0, min(1.0, at))) for at in bar.interval)
            parts += [
                _line(low, y, high, y, _color(0), 2),
                *(_line(x, y - 5, x, y + 5, _color(0), 2) for x in (low, high)),
            ]
        told = f"{bar.name}: {100 * bar.value:.1f} %"
        parts.append(
            f'<circle cx="{_across(bar.value):.1f}" cy="{y:.1f}" r="5" fill="{_color(0)}">{_title(told)}</circle>'
        )
    return _svg(_rows_height(len(bars)), title, parts)


def histograms(counts: Mapping[str, Sequence[tuple[int, int]]], title: str, x_label: str) -> str:
    """Return one histogram per name: of 0, 1, ... steps the successes, and the failures hollow on top.

    Args:
        counts: Successes and failures by number of steps; all of the same length.
        title: Of the plot.
        x_label: Of the axis.
    """
    n = max(len(own) for own in counts.values())
    row, parts = 2 * ROW, list[str]()
    bottom = TOP + row * len(counts)
    wide = (WIDTH - LEFT - RIGHT) / n
    for i, (name, own) in enumerate(counts.items()):
        base = TOP + row * (i + 1) - 6
        most = max(1, *(good + bad for good, bad in own))
        parts += [_row_name(base - 4, name), _line(LEFT, base, WIDTH - RIGHT, base, "var(--line)")]
        for steps, (good, bad) in enumerate(own):
            x, unit = LEFT + wide * steps, (row - 14) / most
            told = f"{name}, {steps} grasps: {good} solved, {bad} failed"
            if good:
                parts.append(_rect(x, base - unit * good, wide - 1, unit * good, "var(--good)", told))
            if bad:
                y, size = base - unit * (good + bad), unit * bad
                parts.append(_rect(x + 1, y + 1, wide - 3, size - 1, "var(--bad)", told, is_hollow=True))
    every = _spacing(n - 1)
    parts += [_text(LEFT + wide * (k + 0.5), bottom + 16, str(k), "middle") for k in range(0, n, every)]
    parts += [_text((LEFT + WIDTH - RIGHT) / 2, bottom + 36, x_label, "middle")]
    return _svg(bottom + BOTTOM, title, parts)


def curves(lines: Sequence[Curve], title: str, x_label: str, y_label: str) -> str:
    """Return lines with intervals over 0 to 100 percent both ways."""
    height, bottom = 380, 380 - BOTTOM
    parts = _frame(bottom, y_label)
    parts += [_text(_wide(k / TICKS), bottom + 18, f"{100 * k / TICKS:.0f} %", "middle") for k in range(TICKS + 1)]
    parts.append(_text((70 + WIDTH - RIGHT) / 2, bottom + 38, x_label, "middle"))
    for i, line in enumerate(lines):
        shift = 4 * (i - (len(lines) - 1) / 2)
        spots = [(_wide(x) + shift, _up(y, bottom), interval) for x, y, interval in line.points]
        parts.append(_polyline([(x, y) for x, y, _ in spots], i))
        for x, y, interval in spots:
            if interval is not None:
                parts.append(_line(x, _up(interval.low, bottom), x, _up(interval.high, bottom), _color(i), 1.5))
            parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{_color(i)}"/>')
    return _with_legend(height, title, parts, [line.name for line in lines])


def survival(shares: Mapping[str, Sequence[float]], title: str, x_label: str, y_label: str) -> str:
    """Return staircases: of every name the share left after 0, 1, ... steps."""
    height, bottom = 380, 380 - BOTTOM
    n = max(len(own) for own in shares.values()) - 1
    parts = _frame(bottom, y_label)
    parts += [_text(_wide(k / n), bottom + 18, str(k), "middle") for k in range(0, n + 1, _spacing(n))]
    parts.append(_text((70 + WIDTH - RIGHT) / 2, bottom + 38, x_label, "middle"))
    for i, own in enumerate(shares.values()):
        points: list[tuple[float, float]] = []
        for k, share in enumerate(own):
            if points:
                points.append((_wide(k / n), points[-1][1]))
            points.append((_wide(k / n), _up(share, bottom)))
        parts.append(_polyline(points, i))
    return _with_legend(height, title, parts, list(shares))


def stacks(counts: Mapping[str, Mapping[str, int]], totals: Mapping[str, int], title: str) -> str:
    """Return one bar per name, each of its parts a share of the name's total."""
    kinds = list(dict.fromkeys(kind for own in counts.values() for kind in own))
    parts = _percent_axis(len(counts))
    for i, (name, own) in enumerate(counts.items()):
        y, x = TOP + ROW * (i + 0.5), float(LEFT)
        parts.append(_row_name(y + 4, name))
        for kind, n in ((kind, n) for kind, n in own.items() if n):
            size = (WIDTH - LEFT - RIGHT) * n / totals[name]
            parts.append(_rect(x, y - 9, size, 18, _color(kinds.index(kind)), f"{name}: {kind} {n} of {totals[name]}"))
            if size > 8 * len(str(n)) + 4:
                parts.append(f'<text class="on" x="{x + size / 2:.1f}" y="{y + 4:.1f}" text-anchor="middle">{n}</text>')
            x += size
    return _with_legend(_rows_height(len(counts)), title, parts, kinds)


def standalone(svg: str) -> str:
    """Return a plot that needs no page around it: on white, with the colours of the page's light style."""
    style = resources.files("thinkgrasp.benchmark").joinpath("report.css").read_text("utf-8")
    colors: dict[str, str] = dict(re.findall(r"(--\w+): (#\w+)", style.partition("@media")[0]))
    head, _, rest = svg.partition(">")
    font = f' font-family="sans-serif" font-size="13" fill="{colors["--ink"]}"'
    plain = f'{head}{font}>\n<rect width="100%" height="100%" fill="#fff"/>{rest}'
    plain = plain.replace('class="on"', f'fill="{colors["--on"]}" font-weight="bold"')
    return re.sub(r"var\((--\w+)\)", lambda found: colors[found[1]], plain)


def _percent_axis(n_rows: int) -> list[str]:
    bottom = TOP + ROW * n_rows
    parts: list[str] = []
    for k in range(TICKS + 1):
        x = _across(k / TICKS)
        parts += [_line(x, TOP, x, bottom, "var(--line)"), _text(x, bottom + 18, f"{100 * k / TICKS:.0f} %", "middle")]
    return parts


def _frame(bottom: float, y_label: str) -> list[str]:
    parts = [f'<g transform="translate(16 {(TOP + bottom) / 2:.0f}) rotate(-90)">{_text(0, 0, y_label, "middle")}</g>']
    for k in range(TICKS + 1):
        y = _up(k / TICKS, bottom)
        parts += [_line(70, y, WIDTH - RIGHT, y, "var(--line)"), _text(62, y + 4, f"{100 * k / TICKS:.0f} %", "end")]
    return parts


def _with_legend(height: float, title: str, parts: Sequence[str], names: Sequence[str]) -> str:
    """Add names with their marks, left to right in rows below the plot."""
    legend: list[str] = []
    x, y = 20.0, height + 12.0
    for i, name in enumerate(names):
        wide = 44 + 7.6 * len(name)
        if x + wide > WIDTH and x > 20:
            x, y = 20.0, y + 22
        dash = _dash(i)
        legend += [
            f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{x + 24:.1f}" y2="{y:.1f}" '
            f'stroke="{_color(i)}" stroke-width="4"{dash}/>',
            _text(x + 30, y + 4, name, "start"),
        ]
        x += wide
    return _svg(y + 18, title, [*parts, *legend])


def _svg(height: float, title: str, parts: Sequence[str]) -> str:
    size = f'viewBox="0 0 {WIDTH} {height:.0f}"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {size} role="img" aria-label={quoteattr(title)}>'
    return "\n".join([head, *parts, "</svg>"])


def _rows_height(n_rows: int) -> float:
    return TOP + ROW * n_rows + BOTTOM - 14


def _spacing(n: int) -> int:
    return next(step for step in (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000) if n <= 15 * step)


def _across(rate: float) -> float:
    return LEFT + rate * (WIDTH - LEFT - RIGHT)


def _wide(rate: float) -> float:
    return 70 + rate * (WIDTH - 70 - RIGHT)


def _up(rate: float, bottom: float) -> float:
    return bottom - rate * (bottom - TOP)


def _color(i: int) -> str:
    return f"var(--s{i % N_COLORS})"


def _dash(i: int) -> str:
    dash = DASHES[i // N_COLORS % len(DASHES)]
    return f' stroke-dasharray="{dash}"' if dash else ""


def _polyline(points: Sequence[tuple[float, float]], i: int) -> str:
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return f'<polyline points="{path}" fill="none" stroke="{_color(i)}" stroke-width="2.2"{_dash(i)}/>'


def _line(x0: float, y0: float, x1: float, y1: float, color: str, width: float = 1) -> str:
    return f'<line x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}" stroke="{color}" stroke-width="{width:g}"/>'


def _rect(x: float, y: float, wide: float, high: float, color: str, told: str, *, is_hollow: bool = False) -> str:
    where = f'x="{x:.1f}" y="{y:.1f}" width="{max(wide, 0.5):.1f}" height="{max(high, 0.5):.1f}"'
    paint = f'fill="none" stroke="{color}" stroke-width="1.5"' if is_hollow else f'fill="{color}"'
    return f"<rect {where} {paint}>{_title(told)}</rect>"


def _title(words: str) -> str:
    return f"<title>{escape(words)}</title>"


def _row_name(y: float, name: str) -> str:
    shown = name if len(name) <= MAX_NAME else f"{name[: MAX_NAME - 1]}…"
    return _text(LEFT - 10, y, shown, "end")


def _text(x: float, y: float, words: str, anchor: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(words)}</text>'
