"""Where labelled areas meet in the image, and whether depth steps there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.perception.morphology import Labels, Nearest, nearest_area
from thinkgrasp.types import Array

INSET_PX = 3
"""Depth is compared this far inside both areas: sensors smear a step over a few pixels."""
STEP_M = (0.010, 0.008)
"""A residual of a + b z [m] is a step."""
MIN_FACING = 0.2
"""A surface seen at a greater slant may be smear, whose tangent plane would explain any step away."""


@dataclass(frozen=True, eq=False)
class Edges:
    """One entry per pair of neighbouring pixels with different labels."""

    a: NDArray[np.intp]
    """0-based label (label 1 is 0)."""
    b: NDArray[np.intp]
    step: NDArray[np.int8]
    """+1: a lies in front of b by a step, -1: b in front of a, 0: no step."""
    blind: NDArray[np.bool_]
    """Whether pixels without depth lie between."""
    pixel_a: NDArray[np.intp]
    """Flat index of the pixel of a at which depth was compared."""
    pixel_b: NDArray[np.intp]

    @classmethod
    def none(cls) -> Edges:
        """Return no borders."""
        z = np.zeros
        return cls(z(0, np.intp), z(0, np.intp), z(0, np.int8), z(0, bool), z(0, np.intp), z(0, np.intp))

    def relabelled(self, labels: Labels) -> Edges:
        """Return the borders of other labels (H, W) that run along these ones, those across missing depth left out."""
        a, b = labels.ravel()[self.pixel_a] - 1, labels.ravel()[self.pixel_b] - 1
        keep = (a >= 0) & (b >= 0) & (a != b) & ~self.blind
        return Edges(
            a[keep].astype(np.intp),
            b[keep].astype(np.intp),
            self.step[keep],
            self.blind[keep],
            self.pixel_a[keep],
            self.pixel_b[keep],
        )


def find_edges(
    labels: Labels,
    points: Array,
    normals: Array,
    reach_px: int = 0,
    blind_reach_px: int = 0,
    nearest: Nearest | None = None,
) -> Edges:
    """Compare depth across every border between two labels.

    A step is where neither side's tangent plane predicts the other side's depth.

    Args:
        labels: (H, W).
        points: (H, W, 3) [m].
        normals: (H, W, 3) unit; NaN where unknown.
        reach_px: Labels that are at most twice this far apart, with unlabelled pixels between, meet too.
        blind_reach_px: The same where the pixels between have no depth.
        nearest: What nearest_area(labels) returns, where it is known already.
    """
    index = np.arange(labels.size).reshape(labels.shape)
    if reach_px:
        nearest = nearest or nearest_area(labels)
        reach = np.where(np.isfinite(points[..., 2]), reach_px, max(reach_px, blind_reach_px))
        index = np.where(nearest.distance_px <= reach, nearest.pixel, index)
    flat_points, flat_normals = points.reshape(-1, 3), normals.reshape(-1, 3)
    filled = labels.flat[index]
    has_depth = np.isfinite(flat_points[:, 2])
    found: list[tuple[NDArray[np.integer | np.bool_], ...]] = []
    own = np.arange(labels.size).reshape(labels.shape)
    for axis in (0, 1):
        image = filled if axis == 1 else filled.T
        where = index if axis == 1 else index.T
        row, col = np.nonzero((image[:, 1:] != image[:, :-1]) & (image[:, 1:] > 0) & (image[:, :-1] > 0))
        la, lb = image[row, col], image[row, col + 1]
        ca, cb = col.copy(), col + 1
        here = own if axis == 1 else own.T
        blind = ~has_depth[here[row, ca]] | ~has_depth[here[row, cb]]
        for _ in range(INSET_PX):
            back = np.maximum(ca - 1, 0)
            ca = np.where(image[row, back] == la, back, ca)
            on = np.minimum(cb + 1, image.shape[1] - 1)
            cb = np.where(image[row, on] == lb, on, cb)
        ia, ib = where[row, ca], where[row, cb]
        step = _step(flat_points[ia], flat_normals[ia], flat_points[ib], flat_normals[ib])
        found.append((la - 1, lb - 1, step, blind, ia, ib))
    a, b, step, blind, ia, ib = (np.concatenate(column) for column in zip(*found, strict=True))
    return Edges(
        a.astype(np.intp),
        b.astype(np.intp),
        step.astype(np.int8),
        blind.astype(bool),
        ia.astype(np.intp),
        ib.astype(np.intp),
    )


def _step(pa: Array, na: Array, pb: Array, nb: Array) -> NDArray[np.int8]:
    za, zb = pa[:, 2], pb[:, 2]
    plain = np.abs(za - zb)
    with np.errstate(divide="ignore", invalid="ignore"):
        residual_b = np.where(_facing(pa, na) > MIN_FACING, np.abs(zb - _predict(pa, na, pb)), plain)
        residual_a = np.where(_facing(pb, nb) > MIN_FACING, np.abs(za - _predict(pb, nb, pa)), plain)
    residual = np.fmin(np.fmin(residual_a, residual_b), plain)
    stepped = residual > STEP_M[0] + STEP_M[1] * np.minimum(za, zb)
    return np.where(stepped, np.where(za < zb, 1, -1), 0).astype(np.int8)


def _facing(p: Array, n: Array) -> Array:
    """Cosine (N,) between normal and line of sight; NaN where the normal is unknown."""
    return -(p * n).sum(1) / np.linalg.norm(p, axis=1)


def _predict(p: Array, n: Array, target: Array) -> Array:
    """Depth (N,) at which the ray through `target` meets the plane through p with normal n."""
    return (n * p).sum(1) / (n * (target / target[:, 2:])).sum(1)


def tabulate(edges: Edges, n: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return per pair (n, n) the number of pixels in contact (symmetric), and [i, j]: i in front of j by a step."""
    level, first, second = edges.step == 0, edges.step > 0, edges.step < 0
    contact = count_pairs(edges.a[level], edges.b[level], n)
    front = count_pairs(edges.a[first], edges.b[first], n) + count_pairs(edges.b[second], edges.a[second], n)
    return contact + contact.T, front


def count_pairs(a: NDArray[np.intp], b: NDArray[np.intp], n: int) -> NDArray[np.int64]:
    """Return how often each pair (n, n) occurs."""
    return np.bincount(a * n + b, minlength=n * n).reshape(n, n).astype(np.int64)
