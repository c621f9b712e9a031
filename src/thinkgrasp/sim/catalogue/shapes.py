"""Closed surfaces: rings joined to a skin, and convex hulls.

A surface is (vertices (V, 3) float64 [m], faces (F, 3) int64), closed, counter-clockwise seen from outside.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

Float = NDArray[np.float64]
Surface = tuple[Float, NDArray[np.int64]]


def skin(rings: Float, *, closed: bool = False) -> Surface:
    """Join rings (K, S, 3) that run counter-clockwise about their direction of travel.

    Args:
        rings: A ring whose points coincide is a tip.
        closed: Whether the last ring joins the first; if not, the first and last must be tips.
    """
    count, sides = rings.shape[:2]
    index = np.arange(count * sides).reshape(count, sides)
    tips = np.ptp(rings, axis=1).max(axis=1) < 1e-9
    index[tips] = index[tips, :1]
    low, high = (index, np.roll(index, -1, axis=0)) if closed else (index[:-1], index[1:])
    low_next, high_next = np.roll(low, -1, axis=1), np.roll(high, -1, axis=1)
    faces = np.concatenate(
        [
            np.stack([low, low_next, high_next], axis=-1).reshape(-1, 3),
            np.stack([low, high_next, high], axis=-1).reshape(-1, 3),
        ]
    )
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    used, renumbered = np.unique(faces, return_inverse=True)
    return rings.reshape(-1, 3)[used], renumbered.reshape(-1, 3).astype(np.int64)


def superellipse(sides: int, power: float = 2.0) -> Float:
    """Return (sides, 2) points of |x|^power + |y|^power = 1, counter-clockwise; 2 is a circle, 5 nearly a square."""
    angle = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c, s], axis=1) / ((np.abs(c) ** power + np.abs(s) ** power) ** (1 / power))[:, None]


def loft(sections: Float, *, sides: int, power: float = 2.0) -> Surface:
    """Stack superellipses along z.

    Args:
        sections: (K, 4) z, half width in x, half width in y, centre in x [m]; the ends are closed flat.
        sides: Corners of a section.
        power: See `superellipse`.
    """
    outline = superellipse(sides, power)
    z, a, b, x = np.asarray(sections, np.float64).T
    rings = np.stack(
        [
            outline[:, 0] * a[:, None] + x[:, None],
            outline[:, 1] * b[:, None],
            np.broadcast_to(z[:, None], (len(z), sides)),
        ],
        axis=-1,
    )
    first, last = (np.broadcast_to(r.mean(axis=0), (1, sides, 3)) for r in (rings[0], rings[-1]))
    return skin(np.concatenate([first, rings, last]))


def revolve(outline: Float, *, sides: int) -> Surface:
    """Turn a closed outline (K, 2) of (radius, z), counter-clockwise with the radius to the right, about z."""
    circle = superellipse(sides)
    rings = np.concatenate(
        [
            outline[:, None, :1] * circle[None],
            np.broadcast_to(outline[:, None, 1:], (len(outline), sides, 1)),
        ],
        axis=-1,
    )
    on_axis = outline[:, 0] < 1e-9
    return skin(rings, closed=not on_axis.any())


def sweep(path: Float, radii: Float, *, sides: int, closed: bool = False) -> Surface:
    """Carry a circle of radius radii (K,) along a path (K, 3) [m]; open ends are round."""
    ahead = np.roll(path, -1, axis=0) - path
    behind = np.roll(ahead, 1, axis=0)
    if not closed:
        ahead[-1], behind[0] = behind[-1], ahead[0]
    tangents = _unit(_unit(ahead) + _unit(behind))
    if not closed:
        path, radii, tangents = _round_ends(path, radii, tangents)
    helper = np.eye(3)[np.argmin(np.abs(tangents[0]))]
    normal = _unit(np.cross(tangents[0], helper))
    circle = superellipse(sides)
    rings = np.empty((len(path), sides, 3))
    for i, (p, r, t) in enumerate(zip(path, radii, tangents, strict=True)):
        normal = _unit(normal - (normal @ t) * t)
        rings[i] = p + r * (circle[:, :1] * normal + circle[:, 1:] * np.cross(t, normal))
    return skin(rings, closed=closed)


def _round_ends(path: Float, radii: Float, tangents: Float) -> tuple[Float, Float, Float]:
    out = np.array([1.0, 0.75]), np.array([0.0, 0.66])
    start = path[0] - radii[0] * out[0][:, None] * tangents[0]
    end = path[-1] + radii[-1] * out[0][::-1, None] * tangents[-1]
    return (
        np.concatenate([start, path, end]),
        np.concatenate([radii[0] * out[1], radii, radii[-1] * out[1][::-1]]),
        np.concatenate([tangents[[0, 0]], tangents, tangents[[-1, -1]]]),
    )


def hull(points: Float) -> Surface:
    """Return the convex hull of points (P, 3)."""
    found = ConvexHull(points)
    faces = found.simplices.astype(np.int64)
    a, b, c = (points[faces[:, i]] for i in range(3))
    inward = np.einsum("fi,fi->f", np.cross(b - a, c - a), found.equations[:, :3]) < 0
    faces[inward] = faces[inward, ::-1]
    used, renumbered = np.unique(faces, return_inverse=True)
    return points[used], renumbered.reshape(-1, 3).astype(np.int64)


def join(*surfaces: Surface) -> Surface:
    """Return one surface of several closed ones."""
    starts = np.cumsum([0, *(len(v) for v, _ in surfaces[:-1])])
    return (
        np.concatenate([v for v, _ in surfaces]),
        np.concatenate([f + start for (_, f), start in zip(surfaces, starts, strict=True)]),
    )


def volume_and_centroid(surface: Surface) -> tuple[float, Float]:
    """Return the enclosed volume [m^3] and its centroid (3,) [m]."""
    vertices, faces = surface
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    signed = np.einsum("fi,fi->f", a, np.cross(b, c)) / 6
    return float(signed.sum()), (signed[:, None] * (a + b + c) / 4).sum(axis=0) / signed.sum()


def _unit(v: Float) -> Float:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)
