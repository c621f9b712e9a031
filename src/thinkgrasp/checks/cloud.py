"""A cloud sorted into blocks, to ask which of its points fall into boxes that move with each grasp."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.types import Grasps

_MAX_PAIRS = 400_000


@dataclass(frozen=True, eq=False)
class BlockedCloud:
    """Points grouped by cubic cells; whole cells far from a box are skipped."""

    points: NDArray[np.float32]
    """(M, 3) [m], ordered by block."""
    starts: NDArray[np.intp]
    """(B + 1,) first point of each block."""
    centers: NDArray[np.float32]
    """(B, 3) middle of each block's points [m]."""
    halves: NDArray[np.float32]
    """(B, 3) half the sides of the box around them [m]."""

    @classmethod
    def of(cls, points: NDArray[np.floating], block_m: float) -> BlockedCloud:
        """Group points (M, 3) into cells of `block_m`."""
        points = np.asarray(points, np.float32)
        if len(points) == 0:
            z = np.zeros
            return cls(points.reshape(0, 3), z(1, np.intp), z((0, 3), np.float32), z((0, 3), np.float32))
        cell = np.floor((points - points.min(axis=0)) / np.float32(block_m)).astype(np.int64)
        size = cell.max(axis=0) + 1
        key = (cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2]
        order = np.argsort(key, kind="stable")
        points, key = points[order], key[order]
        starts = np.append(np.flatnonzero(np.diff(key, prepend=-1)), len(key)).astype(np.intp)
        low = np.minimum.reduceat(points, starts[:-1])
        high = np.maximum.reduceat(points, starts[:-1])
        half = np.float32(0.5)
        return cls(points, starts, ((low + high) * half).astype(np.float32), ((high - low) * half).astype(np.float32))

    def hit(self, grasps: Grasps, low: NDArray[np.floating], high: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return (N,) True where any point lies in the grasp's own box, corners low and high (N, 3) in its frame."""
        hit = np.zeros(len(grasps), bool)
        for grasp, _, inside in self._pairs(grasps, low, high):
            hit[grasp[inside]] = True
        return hit

    def inside(
        self, grasps: Grasps, low: NDArray[np.floating], high: NDArray[np.floating]
    ) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
        """Return grasp index (K,) and local coordinates (K, 3) [m] of every point inside the grasp's own box."""
        index: list[NDArray[np.intp]] = [np.zeros(0, np.intp)]
        local: list[NDArray[np.float32]] = [np.zeros((0, 3), np.float32)]
        for grasp, p, inside in self._pairs(grasps, low, high):
            index.append(grasp[inside])
            local.append(p[inside])
        return np.concatenate(index), np.concatenate(local)

    def _pairs(
        self, grasps: Grasps, low: NDArray[np.floating], high: NDArray[np.floating]
    ) -> Iterator[tuple[NDArray[np.intp], NDArray[np.float32], NDArray[np.bool_]]]:
        """Yield chunks of (grasp index, local coordinates, inside) over all points in blocks that touch the boxes."""
        if len(grasps) == 0 or len(self.halves) == 0:
            return
        low, high = low.astype(np.float32), high.astype(np.float32)
        R = grasps.rotations
        base = np.einsum("nij,ni->nj", R, grasps.positions)
        touch = np.ones((len(grasps), len(self.halves)), bool)
        for axis in range(3):
            c = R[:, :, axis] @ self.centers.T - base[:, axis : axis + 1]
            half = np.abs(R[:, :, axis]) @ self.halves.T + np.float32(1e-6)
            touch &= (c + half >= low[:, axis : axis + 1]) & (c - half <= high[:, axis : axis + 1])
        grasp, block = np.nonzero(touch)
        counts = np.diff(self.starts)[block]
        total = np.cumsum(counts)
        first = 0
        while first < len(grasp):
            done = total[first - 1] if first else 0
            last = max(int(np.searchsorted(total, done + _MAX_PAIRS, side="right")), first + 1)
            n = counts[first:last]
            g = np.repeat(grasp[first:last], n)
            offset = np.arange(n.sum()) - np.repeat(np.cumsum(n) - n, n)
            p = self.points[np.repeat(self.starts[block[first:last]], n) + offset] - grasps.positions[g]
            local = np.einsum("kij,ki->kj", R[g], p)
            yield g, local, ((local >= low[g]) & (local <= high[g])).all(axis=1)
            first = last


def near_points(points: NDArray[np.float32], grasps: Grasps, reach_m: float) -> NDArray[np.float32]:
    """Return the finite points (K, 3) of a cloud (..., 3) within `reach_m` of the grasps' bounding box."""
    low = grasps.positions.min(axis=0) - np.float32(reach_m)
    high = grasps.positions.max(axis=0) + np.float32(reach_m)
    flat = points.reshape(-1, 3)
    near = np.flatnonzero((flat[:, 2] >= low[2]) & (flat[:, 2] <= high[2]))
    flat = flat[near]
    return flat[((flat[:, :2] >= low[:2]) & (flat[:, :2] <= high[:2])).all(axis=1)]
