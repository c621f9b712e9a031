"""The surface that things stand on, among floor, walls, chairs and second tables, with or without a camera pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError

from thinkgrasp.geometry import Float, fit_plane, rotation_aligning
from thinkgrasp.perception.morphology import connected_areas
from thinkgrasp.types import Array, Mask, SupportPlane

N_SAMPLES = 3000
N_HYPOTHESES = 120
N_PLANES = 5
OBJECT_HEIGHT_M = (0.015, 0.35)
"""Points this far above a plane speak for it being the one that objects stand on."""
GRID_M = 0.015
BORDER_HEIGHT_M = 0.2


@dataclass(frozen=True, eq=False)
class Support:
    """The support plane, its outline, and how the sensor bends it."""

    plane: SupportPlane
    hull: Float
    """(E, 3) half-planes a x + b y + c <= 0 of the outline's convex hull, in the plane's own axes [m]."""
    axes: Float
    """(3, 3) rows: two axes in the plane and the normal."""

    def footprint(self, points: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return the plane coordinates (..., 2) [m] of points (..., 3)."""
        return points @ self.axes[:2].T.astype(points.dtype)

    def distance_outside(self, points: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return how far (...) [m] points (..., 3) lie outside the outline, seen along the normal; <= 0 inside."""
        x, y = (np.ascontiguousarray(points @ axis.astype(points.dtype)) for axis in self.axes[:2])
        distance = np.full(x.shape, -np.inf, points.dtype)
        for a, b, c in self.hull.astype(points.dtype):
            np.maximum(distance, a * x + b * y + c, out=distance)
        return distance


def tolerance(z: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return how far (...) [m] a point at depth z [m] may lie off a flat surface: 5 mm, and growing with z squared."""
    return 0.005 + 0.005 * z * z


def find_support(points: Array, normals: Array, up: Float | None, rng: np.random.Generator) -> Support | None:
    """Find the plane that objects stand on.

    Planes are drawn from oriented points, extracted one after the other, and compared: how much of the view they fill
    (the middle counts more), how much stands on them within their outline, how near they are, and whether their normal
    can be "up".

    Args:
        points: (H, W, 3) [m], camera frame; NaN = no return.
        normals: (H, W, 3) unit, NaN where unknown.
        up: World's up (3,) in the camera frame, or None when the pose is unknown.
        rng: Draws the samples.

    Returns:
        The support, or None when no plane fills at least 2 % of the view.
    """
    height, width = points.shape[:2]
    valid = np.flatnonzero(np.isfinite(normals[..., 0]) & np.isfinite(points[..., 2]))
    if len(valid) < 100:
        return None
    sample = np.sort(rng.choice(valid, min(N_SAMPLES, len(valid)), replace=False))
    p = points.reshape(-1, 3)[sample].astype(np.float64)
    n = normals.reshape(-1, 3)[sample].astype(np.float64)
    v, u = np.divmod(sample, width)
    central = np.exp(-(((u - width / 2) / (0.6 * width)) ** 2) - ((v - height / 2) / (0.6 * height)) ** 2)
    tol = tolerance(p[:, 2]).astype(np.float64)

    best: tuple[float, Float, float] | None = None
    free = np.ones(len(p), bool)
    for _ in range(N_PLANES):
        found = _strongest_plane(p, n, central, tol, free, up, rng)
        if found is None:
            break
        normal, offset = found
        inlier = np.abs(p @ normal + offset) < tol
        free &= ~(inlier & (np.abs(n @ normal) > 0.8))
        score = _support_score(p, central, inlier, normal, offset, up)
        if best is None or score > best[0]:
            best = (score, normal, offset)
    if best is None:
        return None
    return _finish(points, best[1], best[2])


def _upness(normal: Float, up: Float | None) -> float:
    """How well a normal can be up: by the pose where known, else by the image (most cameras are not rolled)."""
    if up is not None:
        return float(normal @ up > 0.94)
    return float(np.clip(0.6 - normal[1], 0.25, 1.0))


def _strongest_plane(
    p: Float, n: Float, central: Float, tol: Float, free: Mask, up: Float | None, rng: np.random.Generator
) -> tuple[Float, float] | None:
    candidates = np.flatnonzero(free)
    if len(candidates) < 60:
        return None
    pick = rng.choice(candidates, min(N_HYPOTHESES, len(candidates)), replace=False)
    normals = n[pick]
    upness = np.array([_upness(m, up) for m in normals])
    normals, pick = normals[upness > 0.05], pick[upness > 0.05]
    if len(pick) == 0:
        return None
    offsets = -np.einsum("ij,ij->i", normals, p[pick])
    q, t = p[candidates], tol[candidates]
    inlier = np.abs(normals @ q.T + offsets[:, None]) < t
    aligned = np.abs(normals @ n[candidates].T) > 0.85
    votes = (inlier & aligned) @ central[candidates]
    k = int(np.argmax(votes))
    normal, offset = normals[k], float(offsets[k])
    for _ in range(3):
        close = (np.abs(q @ normal + offset) < t) & (np.abs(n[candidates] @ normal) > 0.85)
        if close.sum() < max(30, 0.02 * len(p)):
            return None
        normal, offset = fit_plane(q[close])
    return normal, offset


def _support_score(p: Float, central: Float, inlier: Mask, normal: Float, offset: float, up: Float | None) -> float:
    axes = plane_axes(normal)
    hull = _outline(p[inlier] @ axes[:2].T)
    if hull is None:
        return 0.0
    total = central.sum()
    share = central[inlier].sum() / total
    above = p @ normal + offset
    standing = (above > OBJECT_HEIGHT_M[0]) & (above < OBJECT_HEIGHT_M[1])
    inside = ((p @ axes[:2].T) @ hull[:, :2].T + hull[:, 2]).max(axis=1) < 0
    objects = (central[standing & inside] ** 2).sum() / (central**2).sum()
    return min(share, 0.3) * (0.03 + min(objects, 0.3)) * _upness(normal, up) / float(np.median(p[inlier, 2]))


def plane_axes(normal: Float) -> Float:
    """Return right-handed rows (3, 3): two unit axes in the plane and its normal; continuous in the normal."""
    R = rotation_aligning(np.array([0.0, 0.0, -1.0]), normal)
    return np.stack([R[:, 0], -R[:, 1], normal])


def _outline(xy: Float) -> Float | None:
    """Half-planes (E, 3) of the convex hull of the largest patch of points (N, 2)."""
    if len(xy) < 20:
        return None
    cell = np.floor((xy - xy.min(axis=0)) / GRID_M).astype(int)
    size = cell.max(axis=0) + 1
    if size.max() > 2000:
        return None
    grid = np.zeros(size + 8, bool)
    grid[cell[:, 0] + 4, cell[:, 1] + 4] = True
    labels, _ = connected_areas(ndimage.binary_dilation(grid, iterations=4).astype(bool))
    own = labels[cell[:, 0] + 4, cell[:, 1] + 4]
    xy = xy[own == np.bincount(own).argmax()]
    try:
        return ConvexHull(xy).equations
    except QhullError:
        return None


def _finish(points: Array, normal: Float, offset: float) -> Support | None:
    coarse = points[::3, ::3]
    for band in (1.0, 0.7):
        close = np.abs(coarse @ normal.astype(np.float32) + np.float32(offset)) < band * tolerance(coarse[..., 2])
        if close.sum() < 30:
            return None
        normal, offset = fit_plane(coarse[close])
    distance = np.abs(points @ normal.astype(np.float32) + np.float32(offset))
    inliers = distance < tolerance(points[..., 2])
    axes = plane_axes(normal)
    seen = np.concatenate([coarse[inliers[::3, ::3]], _beyond_border(points, inliers, normal)])
    hull = _outline((seen @ axes[:2].T.astype(np.float32)).astype(np.float64))
    if hull is None:
        return None
    plane = SupportPlane(normal, float(offset), inliers, float(np.median(distance[inliers][::5])))
    return Support(plane, hull, axes)


def _beyond_border(points: Array, inliers: Mask, normal: Float) -> Array:
    """Points (N, 3) [m] over the part of the support that may be hidden by things cut off by the image border.

    Where the support runs out of the image, whatever stands up to BORDER_HEIGHT_M on it is in view although its foot is
    not: the outline is widened to where the lines of sight at the border pass that height.
    """
    border = np.zeros(inliers.shape, bool)
    border[:3], border[-3:], border[:, :3], border[:, -3:] = True, True, True, True
    p = points[border & inliers]
    if len(p) == 0:
        return p
    rise = -(p @ normal.astype(np.float32)) / np.linalg.norm(p, axis=1)
    back = np.minimum(BORDER_HEIGHT_M / np.maximum(rise, 0.1), 0.5 * np.linalg.norm(p, axis=1))
    return (p * (1 - back / np.linalg.norm(p, axis=1))[:, None]).astype(np.float32)
