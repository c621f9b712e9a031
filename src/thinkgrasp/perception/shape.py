"""Size and shape of one thing from its visible surface: oriented box, circle fits, descriptors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Surface:
    """Visible points of one thing in support coordinates: x, y in the support, z up [m]."""

    points: Float
    """(N, 3)"""
    normals: Float
    """(N, 3) unit; zero where unknown."""


@dataclass(frozen=True, eq=False)
class Shape:
    """Oriented box and descriptors in support coordinates."""

    center: Float
    """(3,)"""
    axes: Float
    """(3, 3) columns, belonging to extents."""
    extents: Float
    """(3,) longest first [m]"""
    descriptors: tuple[tuple[str, float], ...]


def describe_shape(surface: Surface, toward_camera: Float) -> Shape:
    """Fit a gravity-aligned box, completed where the back is hidden, and name the shape.

    The unseen back is inferred from the circle that the side's normals share (cans, cups, bottles, balls). Without one,
    the hidden depth is taken to be at least half of the visible breadth.

    Args:
        surface: Visible points, at least 10.
        toward_camera: (2,) unit direction in the support plane from the thing to the camera.
    """
    p, n = surface.points, surface.normals
    low, high = np.percentile(p[:, 2], [2, 98.5])
    upright = circle_from_normals(p[:, :2], n[:, :2])
    hull = _hull(p[:, :2])
    rectangle = _smallest_rectangle(hull)
    lying = _lying_cylinder(p, n, rectangle)
    ball = _ball(p, n, float(high))
    bottom = _bottom(float(low), ball or lying)

    round_one = upright if upright is not None and _agrees(upright, rectangle) else ball
    if round_one is not None:
        completion = _ring(round_one)
    elif lying is not None:
        completion = _both_sides(hull, rectangle, lying)
    else:
        completion = _hidden_back(p, hull, toward_camera)
    footprint = _hull(np.concatenate([hull, completion]))
    rectangle = _smallest_rectangle(footprint)
    sides = np.array([*rectangle.sides, max(high - bottom, 0.002)])
    axes = np.zeros((3, 3))
    axes[:2, 0], axes[:2, 1], axes[2, 2] = rectangle.axis, [-rectangle.axis[1], rectangle.axis[0]], 1.0
    order = np.argsort(-sides, kind="stable")
    axes = axes[:, order]
    if np.linalg.det(axes) < 0:
        axes[:, 2] *= -1
    center = np.array([*rectangle.center, (high + bottom) / 2])
    descriptors = _descriptors(surface, sides, rectangle, footprint, upright, lying, ball)
    return Shape(center, axes, sides[order], descriptors)


@dataclass(frozen=True, eq=False)
class Circle:
    center: Float
    radius: float
    degree: float
    """0..1, how well points and normals agree with it, and how much of it is seen."""


@dataclass(frozen=True, eq=False)
class _Rectangle:
    center: Float
    axis: Float
    sides: Float
    """(2,) along axis and across [m]"""


def _ramp(x: float, low: float, high: float) -> float:
    return float(np.clip((x - low) / (high - low), 0.0, 1.0))


def _hull(xy: Float) -> Float:
    try:
        return xy[ConvexHull(xy).vertices]
    except (QhullError, ValueError):
        return xy


def _smallest_rectangle(hull: Float) -> _Rectangle:
    angles = np.radians(np.arange(0, 90, 3.0))
    axes = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    across = np.stack([-axes[:, 1], axes[:, 0]], axis=1)
    a, b = hull @ axes.T, hull @ across.T
    k = int(np.argmin((np.ptp(a, axis=0) + 1e-4) * (np.ptp(b, axis=0) + 1e-4)))
    middle = np.array([a[:, k].min() + a[:, k].max(), b[:, k].min() + b[:, k].max()]) / 2
    center = middle[0] * axes[k] + middle[1] * across[k]
    return _Rectangle(center, axes[k], np.array([np.ptp(a[:, k]), np.ptp(b[:, k])]))


def _fit_center(p: Float, n: Float) -> tuple[Float, float, float] | None:
    """Fit p = c + r n by least squares, twice more without outliers; return centre, radius and RMS residual."""
    keep = np.ones(len(p), bool)
    center, radius, residual = np.zeros(p.shape[1]), 0.0, np.zeros(len(p))
    for _ in range(3):
        if keep.sum() < 12:
            return None
        p_mean, n_mean = p[keep].mean(axis=0), n[keep].mean(axis=0)
        spread = ((n[keep] - n_mean) ** 2).sum()
        if spread < 1e-9:
            return None
        radius = float(((p[keep] - p_mean) * (n[keep] - n_mean)).sum() / spread)
        center = p_mean - radius * n_mean
        residual = np.linalg.norm(p - center - radius * n, axis=1)
        keep = residual < max(2.0 * float(np.median(residual)), 1e-4)
    return center, radius, float(np.sqrt((residual[keep] ** 2).mean()))


def _arc(n: Float, sector: int = 16) -> float:
    """Share of the circle of directions (N, 2) that is covered."""
    bins = np.bincount(((np.arctan2(n[:, 1], n[:, 0]) / (2 * np.pi) * sector).astype(int)) % sector, minlength=sector)
    return float((bins > 0.01 * len(n)).mean())


def circle_from_normals(xy: Float, n: Float) -> Circle | None:
    """The circle around a vertical axis that the side's points and outward normals share."""
    length = np.linalg.norm(n, axis=1)
    side = length > 0.6
    if side.sum() < 30 or side.mean() < 0.15:
        return None
    fit = _fit_center(xy[side], n[side] / length[side, None])
    if fit is None:
        return None
    center, radius, rms = fit
    if not 0.008 < radius < 0.20:
        return None
    degree = (1 - _ramp(rms / radius, 0.15, 0.45)) * _ramp(_arc(n[side]), 0.12, 0.32)
    return Circle(center, radius, degree) if degree > 0.2 else None


def _agrees(circle: Circle, seen: _Rectangle) -> bool:
    """Whether a circle of that size can carry what is seen: about as broad as the longer side, but for a handle."""
    return 0.68 < 2 * circle.radius / float(seen.sides.max()) < 1.3


def _lying_cylinder(p: Float, n: Float, seen: _Rectangle) -> Circle | None:
    """The circle around the longer horizontal axis, for cans and bottles that lie."""
    if seen.sides.max() < 1.25 * seen.sides.min():
        return None
    axis = seen.axis if seen.sides[0] >= seen.sides[1] else np.array([-seen.axis[1], seen.axis[0]])
    across = np.array([-axis[1], axis[0]])
    section = np.stack([p[:, :2] @ across, p[:, 2]], axis=1)
    m = np.stack([n[:, :2] @ across, n[:, 2]], axis=1)
    length = np.linalg.norm(m, axis=1)
    side = length > 0.7
    if side.sum() < 30:
        return None
    fit = _fit_center(section[side], m[side] / length[side, None])
    if fit is None:
        return None
    center, radius, rms = fit
    if not 0.005 < radius < 0.12 or not 0.4 < center[1] / radius < 2.2:
        return None
    degree = (1 - _ramp(rms / radius, 0.15, 0.5)) * _ramp(_arc(m[side]), 0.12, 0.32) * float(side.mean())
    return Circle(center, radius, degree) if degree > 0.2 else None


def _bottom(low: float, body: Circle | None) -> float:
    """Height of the underside: the round body's own where there is one, and the support where that is near."""
    under = low if body is None else min(low, float(body.center[-1]) - body.radius)
    return 0.0 if under < 0.03 else under


def _ball(p: Float, n: Float, top: float) -> Circle | None:
    known = np.linalg.norm(n, axis=1) > 0.5
    if known.sum() < 30:
        return None
    fit = _fit_center(p[known], n[known])
    if fit is None:
        return None
    center, radius, rms = fit
    if not 0.01 < radius < 0.15 or abs(top - center[2] - radius) > 0.25 * radius or center[2] < 0.6 * radius:
        return None
    spread = float(np.linalg.norm(n[known].std(axis=0)))
    degree = (1 - _ramp(rms / radius, 0.12, 0.35)) * _ramp(spread, 0.35, 0.6)
    return Circle(center, radius, degree) if degree > 0.2 else None


def _ring(circle: Circle) -> Float:
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    return circle.center[:2] + circle.radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _both_sides(hull: Float, seen: _Rectangle, lying: Circle) -> Float:
    """Footprint points on both sides of a lying cylinder's axis, over the length that is seen."""
    axis = seen.axis if seen.sides[0] >= seen.sides[1] else np.array([-seen.axis[1], seen.axis[0]])
    across = np.array([-axis[1], axis[0]])
    along = hull @ axis
    ends = np.array([along.min(), along.max()])[:, None] * axis
    return np.concatenate([ends + (lying.center[0] + s * lying.radius) * across for s in (-1.0, 1.0)])


def _hidden_back(p: Float, hull: Float, toward_camera: Float) -> Float:
    """Footprint points behind the visible ones, so that depth is at least half of the breadth and height allows."""
    across = np.array([-toward_camera[1], toward_camera[0]])
    depth, breadth = np.ptp(hull @ toward_camera), np.ptp(hull @ across)
    missing = min(0.5 * breadth, 0.06, float(np.ptp(p[:, 2]))) - depth
    return hull - max(missing, 0.0) * toward_camera


def _descriptors(
    surface: Surface,
    sides: Float,
    rectangle: _Rectangle,
    footprint: Float,
    upright: Circle | None,
    lying: Circle | None,
    ball: Circle | None,
) -> tuple[tuple[str, float], ...]:
    p, n = surface.points, surface.normals
    horizontal = np.sort(sides[:2])
    s = np.sort(sides)
    circular = _circularity(footprint)
    up_degree = upright.degree if upright is not None and _agrees(upright, rectangle) else 0.0
    degrees = {
        "round": max(ball.degree if ball else 0.0, 0.8 * _ramp(circular, 0.86, 0.94) * max(up_degree, 0.3)),
        "cylindrical": max(up_degree, lying.degree if lying else 0.0, _lid_degree(p, n, circular)),
        "box-like": _box_degree(n, rectangle),
        "flat": (1 - _ramp(s[0] / max(s[1], 1e-3), 0.3, 0.6)) * (1 - _ramp(s[0], 0.025, 0.045)),
        "elongated": _ramp(s[2] / max(s[1], 1e-3), 1.5, 2.6),
        "hollow": _hollow_degree(p, n, rectangle, horizontal),
    }
    if ball is not None:
        degrees["cylindrical"] *= 1 - 0.6 * ball.degree
    degrees["round"] = max(degrees["round"], 0.9 * degrees["hollow"] * _ramp(circular, 0.86, 0.94))
    degrees["box-like"] *= 1 - 0.7 * max(degrees["cylindrical"], degrees["round"], degrees["hollow"])
    ranked = sorted(((k, round(v, 3)) for k, v in degrees.items()), key=lambda kv: -kv[1])
    return tuple((k, v) for k, v in ranked if v >= 0.1)


def _lid_degree(p: Float, n: Float, circular: float) -> float:
    """How much of the thing is a level round lid that stands above the support: a cylinder seen from above."""
    top = float(np.percentile(p[:, 2], 95))
    lid = (n[:, 2] > 0.85) & (p[:, 2] > top - 0.01)
    return _ramp(float(lid.mean()), 0.5, 0.75) * _ramp(circular, 0.9, 0.96) * _ramp(top, 0.01, 0.025)


def _circularity(hull: Float) -> float:
    """Isoperimetric quotient 4 pi A / P^2 of a convex polygon's vertices in order."""
    nxt = np.roll(hull, -1, axis=0)
    area = 0.5 * abs(float((hull[:, 0] * nxt[:, 1] - nxt[:, 0] * hull[:, 1]).sum()))
    perimeter = float(np.linalg.norm(nxt - hull, axis=1).sum())
    return 4 * np.pi * area / max(perimeter**2, 1e-9)


def _box_degree(n: Float, rectangle: _Rectangle) -> float:
    """Share of normals that point along one of three perpendicular directions, above what chance gives."""
    known = n[np.linalg.norm(n, axis=1) > 0.5]
    if len(known) < 20:
        return 0.0
    best = 0.0
    for turn in np.radians([0, 15, 30, 45, 60, 75]):
        c, s = np.cos(turn), np.sin(turn)
        a = np.array([c * rectangle.axis[0] - s * rectangle.axis[1], s * rectangle.axis[0] + c * rectangle.axis[1]])
        along = np.abs(known @ np.array([[a[0], -a[1], 0], [a[1], a[0], 0], [0, 0, 1]])).max(axis=1)
        best = max(best, float((along > np.cos(np.radians(20))).mean()))
    return _ramp(best, 0.6, 0.9)


def _hollow_degree(p: Float, n: Float, rectangle: _Rectangle, horizontal: Float) -> float:
    """How much the thing is open at the top: a rim all around, a middle that lies lower, walls that face inwards."""
    aspect = horizontal[1] / max(horizontal[0], 1e-3)
    offset = (p[:, :2] - rectangle.center) / max(horizontal.mean() / 2, 1e-3)
    radius = np.linalg.norm(offset, axis=1)
    rim = float(np.percentile(p[:, 2], 96))
    high = (p[:, 2] > 0.6 * rim) & (radius > 0.5)
    around = _arc(offset[high], 12) if high.sum() > 12 else 0.0
    closed = _ramp(around, 0.55, 0.8) * (1 - _ramp(aspect, 1.6, 2.0))
    inward = -((offset / np.maximum(radius, 1e-6)[:, None]) * n[:, :2]).sum(1)
    inside = (inward > 0.35) & (radius > 0.25) & (p[:, 2] < rim - 0.006)
    walls = _ramp(float(inside.mean()), 0.06, 0.22)
    middle = p[radius < 0.4, 2]
    sunk = rim - float(np.median(middle)) if len(middle) > 0.03 * len(p) else 0.0
    return closed * max(walls, _ramp(sunk / max(rim, 0.01), 0.25, 0.6))
