"""Convex pieces that physics collides, made from the same numbers as the surfaces; all lengths in metres."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.geometry import quat_wxyz, rotation_aligning, rotation_from_quat_wxyz
from thinkgrasp.sim.catalogue.shapes import superellipse
from thinkgrasp.sim.objects import CollisionPiece

Float = NDArray[np.float64]
Pieces = tuple[CollisionPiece, ...]

RING = 12
"""Corners of a section of a hull: two sections make 24 points."""
FAITHFUL_M = 0.0012
"""A curve is replaced by straight lines that leave it by no more than this."""


def hull(points: Float) -> CollisionPiece:
    """Return the hull of points (P, 3)."""
    return CollisionPiece("hull", points_m=np.asarray(points, np.float64))


def capsule(p: Float, q: Float, radius: float) -> CollisionPiece:
    """Return a capsule between two points (3,)."""
    length = float(np.linalg.norm(q - p))
    rotation = rotation_aligning(np.array([0.0, 0.0, 1.0]), (q - p) / length)
    return CollisionPiece("capsule", (float(radius), length / 2), _triple((p + q) / 2), _quat(rotation))


def chain(path: Float, radii: Float, *, closed: bool = False) -> Pieces:
    """Return capsules along a path (K, 3) with radii (K,)."""
    if closed:
        path, radii = np.concatenate([path, path[:1]]), np.append(radii, radii[0])
    kept = straighten(np.column_stack([path, radii]))
    return tuple(capsule(p[:3], q[:3], (p[3] + q[3]) / 2) for p, q in pairwise(kept))


def stack(sections: Float, power: float = 2.0) -> Pieces:
    """Return cylinders and hulls that fill superellipses stacked along z, (K, 4) as in `shapes.loft`."""
    kept = straighten(np.asarray(sections, np.float64))
    outline = superellipse(RING, power)
    spread = (1 + 1 / np.cos(np.pi / RING)) / 2 if power == 2.0 else 1.0
    pieces = []
    for low, high in pairwise(kept):
        if high[0] - low[0] < 1e-6:
            continue
        round_and_straight = power == 2.0 and np.ptp([*low[1:3], *high[1:3]]) < FAITHFUL_M and low[3] == high[3]
        if round_and_straight:
            r = float(np.mean([*low[1:3], *high[1:3]]))
            middle = (float(low[3]), 0.0, float(low[0] + high[0]) / 2)
            pieces.append(CollisionPiece("cylinder", (r, float(high[0] - low[0]) / 2), middle))
        else:
            rings = [
                np.column_stack([outline * spread * s[1:3] + [s[3], 0.0], np.full(RING, s[0])]) for s in (low, high)
            ]
            pieces.append(hull(np.concatenate(rings)))
    return tuple(pieces)


def wedges(outer: Float, inner: Float, count: int) -> Pieces:
    """Return the wall between two profiles (K, 2) of (radius, z) as `count` wedges around z per step."""
    angle = 2 * np.pi * np.arange(count + 1) / count
    spread = (1 + 1 / np.cos(np.pi / count)) / 2
    circle = np.column_stack([np.cos(angle), np.sin(angle)]) * spread
    pieces = []
    for step in range(len(outer) - 1):
        corners = np.concatenate([outer[step : step + 2], inner[step : step + 2]])
        for i in range(count):
            points = [[*(r * circle[j]), z] for r, z in corners for j in (i, i + 1)]
            pieces.append(hull(np.array(points)))
    return tuple(pieces)


def moved(piece: CollisionPiece, rotation: Float, offset: Float) -> CollisionPiece:
    """Return the piece turned by rotation (3, 3), then shifted by offset (3,)."""
    if piece.points_m is not None:
        return replace(piece, points_m=piece.points_m @ rotation.T + offset)
    return replace(
        piece,
        position_m=_triple(rotation @ np.array(piece.position_m) + offset),
        quat_wxyz=_quat(rotation @ rotation_from_quat_wxyz(np.array(piece.quat_wxyz))),
    )


def scaled(piece: CollisionPiece, factor: float) -> CollisionPiece:
    """Return the piece grown about the origin."""
    return replace(
        piece,
        size_m=tuple(factor * s for s in piece.size_m),
        position_m=_triple(factor * np.array(piece.position_m)),
        points_m=None if piece.points_m is None else factor * piece.points_m,
    )


def straighten(points: Float, tolerance_m: float = FAITHFUL_M) -> Float:
    """Drop points (K, D) of a polyline that lie within the tolerance of the line between those kept.

    References:
        Douglas and Peucker, 1973.
    """
    if len(points) < 3:
        return points
    start, line = points[0], points[-1] - points[0]
    along = np.clip((points - start) @ line / max(line @ line, 1e-18), 0, 1)
    off = np.linalg.norm(points - start - along[:, None] * line, axis=1)
    worst = int(off.argmax())
    if off[worst] <= tolerance_m:
        return points[[0, -1]]
    return np.concatenate([straighten(points[: worst + 1], tolerance_m)[:-1], straighten(points[worst:], tolerance_m)])


def _triple(v: Float) -> tuple[float, float, float]:
    return float(v[0]), float(v[1]), float(v[2])


def _quat(rotation: Float) -> tuple[float, float, float, float]:
    w, x, y, z = quat_wxyz(rotation)
    return float(w), float(x), float(y), float(z)
