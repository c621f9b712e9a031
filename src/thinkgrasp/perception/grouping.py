"""From patches to things: agglomerative merging over the patch adjacency graph.

Two patches belong to one thing unless depth jumps between them, or the surface folds inwards, or the colour changes
where depth is not to be trusted. Hollow things are the exception: across a rim depth jumps although it is one thing.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.perception.edges import find_edges
from thinkgrasp.perception.morphology import Labels
from thinkgrasp.types import Array

MERGE_BELOW = 0.6
CONCAVE_FREE_DEG = 16.0
CONCAVE_FULL_DEG = 55.0
COLOR_FREE = 14.0
COLOR_FULL = 70.0
HUE_FREE = 20.0
SLANT_FREE, SLANT_FULL = 0.6, 0.25
"""Cosine between normal and line of sight: a slanted patch where the colour changes is likely smeared depth."""


@dataclass(frozen=True, eq=False)
class Adjacency:
    """Neighbouring patches a < b (0-based) and the mean cost of joining them across their common boundary."""

    a: NDArray[np.intp]
    b: NDArray[np.intp]
    length_px: NDArray[np.float64]
    cost: NDArray[np.float64]
    """0 = surely one thing, 1 = surely two."""


@dataclass(frozen=True, eq=False)
class PatchStatistics:
    """Means over the patches."""

    count: NDArray[np.float64]
    center: NDArray[np.float64]
    """(n, 3) [m]"""
    normal: NDArray[np.float64]
    """(n, 3) unit"""
    lab: NDArray[np.float64]
    """(n, 3)"""

    @property
    def facing(self) -> NDArray[np.float64]:
        """(n,) cosine between normal and line of sight"""
        return -(self.normal * self.center).sum(axis=1) / np.maximum(np.linalg.norm(self.center, axis=1), 1e-6)


def patch_statistics(labels: Labels, points: Array, normals: Array, lab: Array) -> PatchStatistics:
    """Average position, normal and colour of labels 1..n."""
    inside = labels > 0
    index = labels[inside] - 1
    n = int(labels.max())
    count = np.bincount(index, minlength=n).astype(np.float64)

    def mean(image: Array) -> NDArray[np.float64]:
        values = np.nan_to_num(image[inside])
        return np.stack([np.bincount(index, values[:, c], minlength=n) for c in range(3)], axis=1) / count[:, None]

    normal = mean(normals)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-6)
    return PatchStatistics(count, mean(points), normal, mean(lab))


def patch_adjacency(labels: Labels, points: Array, normals: Array, patches: PatchStatistics) -> Adjacency:
    """Compare neighbouring patches: depth steps, folds, colour.

    References:
        Stein et al., Object partitioning using local convexity, CVPR 2014: inward folds separate things.
    """
    edges = find_edges(labels, points, normals)
    n = len(patches.count)
    key, inverse = np.unique(np.minimum(edges.a, edges.b) * n + np.maximum(edges.a, edges.b), return_inverse=True)
    a, b = np.divmod(key, n)
    length = np.bincount(inverse).astype(np.float64)
    stepped = np.bincount(inverse, edges.step != 0) / length
    return Adjacency(a, b, length, _cost(patches, a, b, stepped))


def _cost(
    patches: PatchStatistics, a: NDArray[np.intp], b: NDArray[np.intp], stepped: NDArray[np.float64]
) -> NDArray[np.float64]:
    line = patches.center[a] - patches.center[b]
    line /= np.maximum(np.linalg.norm(line, axis=1, keepdims=True), 1e-6)
    na, nb = patches.normal[a], patches.normal[b]
    angle = np.degrees(np.arccos(np.clip((na * nb).sum(1), -1, 1)))
    fold = ((na - nb) * line).sum(1)
    concave = np.where(fold < 0, angle, 0.0)
    difference = patches.lab[a] - patches.lab[b]
    color = np.linalg.norm(difference * [0.5, 1.0, 1.0], axis=1)
    hue = np.linalg.norm(difference[:, 1:], axis=1)  # without lightness, which changes with the slant
    c_fold = np.clip((concave - CONCAVE_FREE_DEG) / (CONCAVE_FULL_DEG - CONCAVE_FREE_DEG), 0, 1)
    c_color = np.clip((color - COLOR_FREE) / (COLOR_FULL - COLOR_FREE), 0, 1)
    facing = np.minimum(patches.facing[a], patches.facing[b])
    c_slant = np.clip((SLANT_FREE - facing) / (SLANT_FREE - SLANT_FULL), 0, 1)
    c_hue = np.clip((hue - HUE_FREE) / (COLOR_FULL - HUE_FREE), 0, 1)
    cost = c_fold * (0.7 + 0.6 * c_color) + 0.25 * c_color + 0.9 * c_slant * c_hue
    return np.maximum(np.minimum(cost, 1.0), np.clip((stepped - 0.2) / 0.4, 0, 1))


def merge_patches(n: int, adjacency: Adjacency) -> NDArray[np.intp]:
    """Join neighbours, cheapest first, while the mean cost along the common boundary is below MERGE_BELOW.

    Returns:
        (n,) group index of every patch, 0..m-1.
    """
    neighbours: list[dict[int, tuple[float, float]]] = [{} for _ in range(n)]
    heap: list[tuple[float, int, int, int, int]] = []
    version = [0] * n
    for a, b, length, cost in zip(
        adjacency.a.tolist(), adjacency.b.tolist(), adjacency.length_px.tolist(), adjacency.cost.tolist(), strict=True
    ):
        neighbours[a][b] = neighbours[b][a] = (length, cost * length)
        if cost < MERGE_BELOW:
            heap.append((cost, a, b, 0, 0))
    heapq.heapify(heap)
    parent = list(range(n))
    while heap:
        _, a, b, va, vb = heapq.heappop(heap)
        if version[a] != va or version[b] != vb or parent[a] != a or parent[b] != b:
            continue
        if len(neighbours[a]) < len(neighbours[b]):
            a, b = b, a
        parent[b] = a
        version[a] += 1
        version[b] += 1
        for c, (length, total) in neighbours[b].items():
            if c == a:
                continue
            old = neighbours[a].get(c, (0.0, 0.0))
            joined = (old[0] + length, old[1] + total)
            neighbours[a][c] = neighbours[c][a] = joined
            del neighbours[c][b]
        neighbours[a].pop(b, None)
        neighbours[b].clear()
        for c, (length, total) in neighbours[a].items():
            if total / length < MERGE_BELOW:
                heapq.heappush(heap, (total / length, a, c, version[a], version[c]))

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = parent[i]
        return i

    return np.unique([root(i) for i in range(n)], return_inverse=True)[1]
