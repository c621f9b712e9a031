"""How far points are from convex pieces and from closed surfaces."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from trimesh.triangles import closest_point

from thinkgrasp.geometry import rotation_from_quat_wxyz
from thinkgrasp.sim.objects import CollisionPiece, SimObject

Float = NDArray[np.float64]


def to_piece(piece: CollisionPiece, points: Float) -> Float:
    """Return signed distances (N,), negative inside; exact near the surface except beside a hull's edges."""
    if piece.points_m is not None:
        planes = ConvexHull(piece.points_m).equations
        return (points @ planes[:, :3].T + planes[:, 3]).max(axis=1)
    local = (points - piece.position_m) @ rotation_from_quat_wxyz(np.array(piece.quat_wxyz))
    size = np.array(piece.size_m)
    if piece.shape == "sphere":
        return np.linalg.norm(local, axis=1) - size[0]
    if piece.shape == "capsule":
        local[:, 2] -= np.clip(local[:, 2], -size[1], size[1])
        return np.linalg.norm(local, axis=1) - size[0]
    if piece.shape == "ellipsoid":
        k = np.linalg.norm(local / size, axis=1)
        return k * (k - 1) / np.maximum(np.linalg.norm(local / size**2, axis=1), 1e-9)
    if piece.shape == "box":
        over = np.abs(local) - size
    else:
        over = np.stack([np.linalg.norm(local[:, :2], axis=1), np.abs(local[:, 2])], axis=1) - size
    return np.linalg.norm(np.maximum(over, 0), axis=1) + np.minimum(over.max(axis=1), 0)


def surface_points(piece: CollisionPiece) -> Float:
    """Return points on the surface of a piece, object frame."""
    if piece.points_m is not None:
        return piece.points_m
    if piece.shape == "box":
        local = np.array(np.meshgrid([-1, 0, 1], [-1, 0, 1], [-1, 0, 1])).reshape(3, -1).T * piece.size_m
    else:
        i = np.arange(40) + 0.5
        z, turn = 1 - 2 * i / 40, np.pi * (1 + 5**0.5) * i
        ball = np.column_stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z])
        if piece.shape == "sphere":
            local = ball * piece.size_m[0]
        elif piece.shape == "ellipsoid":
            local = ball * piece.size_m
        elif piece.shape == "capsule":
            local = ball * piece.size_m[0] + np.sign(ball[:, 2:]) * [0, 0, piece.size_m[1]]
        else:
            rim = ball[:, :2] / np.linalg.norm(ball[:, :2], axis=1, keepdims=True) * piece.size_m[0]
            local = np.column_stack([rim, np.sign(z) * piece.size_m[1]])
    return local @ rotation_from_quat_wxyz(np.array(piece.quat_wxyz)).T + piece.position_m


def outside_surface(obj: SimObject, points: Float) -> Float:
    """Return how far points (N, 3) lie outside all visual pieces of an object; 0 inside.

    References:
        Van Oosterom and Strackee, 1983: the solid angle of a triangle; a closed surface adds up to 4 pi inside.
    """
    triangles = np.concatenate([v.vertices[v.faces].astype(np.float64) for v in obj.visuals])
    a, b, c = (triangles[None, :, i] - points[:, None] for i in range(3))
    la, lb, lc = (np.linalg.norm(x, axis=-1) for x in (a, b, c))

    def dot(p: Float, q: Float) -> Float:
        return np.einsum("nfi,nfi->nf", p, q)

    angle = 2 * np.arctan2(dot(a, np.cross(b, c)), la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb).sum(
        axis=1
    )
    out = np.zeros(len(points))
    for i in np.flatnonzero(angle < 2 * np.pi):
        nearest = closest_point(triangles, np.broadcast_to(points[i], (len(triangles), 3)))
        out[i] = np.linalg.norm(nearest - points[i], axis=1).min()
    return out
