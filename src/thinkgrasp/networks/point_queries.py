"""Which points: furthest-point samples, neighbours in balls and cylinders, the three nearest; exact, ties included.

The answers are those of the usual CUDA operators, index for index: strict float32 comparisons of explicit coordinate
differences, the first hits in the order of the points, and their rules for ties. Plain torch, on the CPU or on CUDA.

References:
    Qi et al., PointNet++, NeurIPS 2017; the operators of graspnet-baseline (commit 280c215), against whose kernels,
    compiled for the CPU, the golden data of the tests were made. The code is our own.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from thinkgrasp.errors import InputError

ORIGIN_SQUARED_M = 1e-3
"""Furthest-point sampling leaves out points whose squared distance from the frame's origin is no larger."""
_FAR = 1e10
_THREADS = 512
_BLOCK = 256
_POINTS_PER_BLOCK = 2048
_CENTERS_PER_BLOCK = 512
_PAIRS_PER_BLOCK = 1 << 24
_PICKS_PER_RECORD = 32
Hits = Callable[[Tensor, Tensor], list[Tensor]]
"""From offsets (..., 3) of points to centres, and the centres' indices (...), to a mask (...) per layer: exact."""


def furthest_points(points: Tensor, count: int) -> tuple[Tensor, bool]:
    """Pick points one by one, each furthest from those picked before; the first is point 0.

    Points within 3.16 cm of the frame's origin are never picked, except point 0. Once every other point is taken, picks
    repeat. Of equally far points, the one wins that a reduction over 512 threads keeps: by the bit-reversed index
    modulo the number of threads, then by the index.

    Args:
        points: (N, 3) float32 [m].
        count: How many, more than N included.

    Returns:
        Indices (count,) int64, and whether no pick is known to have been a tie or a repeat: then the same picks, made
        from these points in this order, are the first of them.

    Raises:
        InputError: There is no point.
    """
    _check_points(points)
    squared = _squared(*points.T)
    order = _tie_order(len(points), points.device)
    order = order[squared[order].double() > ORIGIN_SQUARED_M]
    if len(order) == 0:
        return torch.zeros(count, dtype=torch.long, device=points.device), False
    pick = _picks_on_cpu if points.device.type == "cpu" else _picks_on_device
    return pick(points, order, count)


def _tie_order(n: int, device: torch.device) -> Tensor:
    """Indices (n,) of points, the winner of a tie first."""
    bits = min(_THREADS, 1 << (n.bit_length() - 1)).bit_length() - 1
    reversed_bits = np.array([int(f"{k:0{bits}b}"[::-1], 2) if bits else 0 for k in range(1 << bits)])
    return torch.from_numpy(np.argsort(reversed_bits[np.arange(n) % (1 << bits)], kind="stable")).to(device)


def _picks_on_cpu(points: Tensor, order: Tensor, count: int) -> tuple[Tensor, bool]:
    """The loop in numpy, whose calls on small arrays cost least.

    A pick brings no point nearer that is further from it than the last pick was from all before. So the points are
    sorted along one axis and kept in blocks with the largest distance of each, and a pick looks at its slab alone.
    """
    xyz = np.ascontiguousarray(points[order].numpy().T)
    axis = int(np.ptp(xyz, axis=1).argmax())
    rank = np.argsort(xyz[axis], kind="stable")
    where = order.numpy()[rank]
    n_blocks = -(-len(rank) // _BLOCK)
    candidates = np.pad(np.take(xyz, rank, axis=1), ((0, 0), (0, n_blocks * _BLOCK - len(rank))), mode="edge")
    starts: list[float] = candidates[axis, ::_BLOCK].tolist()
    far = np.full(n_blocks * _BLOCK, _FAR, np.float32)
    far[len(rank) :] = -1
    blocks, furthest = far.reshape(n_blocks, _BLOCK), np.empty(n_blocks, np.float32)
    squares = np.empty_like(candidates)
    picked = np.zeros(count, np.int64)
    last = points[0].numpy()[:, None]
    reach, unique = np.inf, True
    for i in range(1, count):
        at = float(last[axis, 0])
        low = max(bisect_left(starts, at - reach) - 1, 0)
        high = max(bisect_right(starts, at + reach), low + 1)
        slab = slice(low * _BLOCK, high * _BLOCK)
        square, distance = squares[:, slab], squares[0, slab]
        np.subtract(candidates[:, slab], last, out=square)
        np.multiply(square, square, out=square)
        np.add(distance, square[1], out=distance)
        np.minimum(far[slab], np.add(distance, square[2], out=distance), out=far[slab])
        np.maximum.reduce(blocks[low:high], axis=1, out=furthest[low:high])
        block = int(furthest.argmax())
        most, row = furthest[block], blocks[block]
        k = block * _BLOCK + int(row.argmax())
        if np.count_nonzero(furthest == most) > 1 or np.count_nonzero(row == most) > 1:
            tied = np.flatnonzero(far == most)
            k = tied[rank[tied].argmin()]
            unique = False
        unique = unique and bool(most > 0)
        reach = float(most) ** 0.5 * (1 + 1e-5)
        picked[i] = where[k]
        last = candidates[:, k : k + 1]
    return torch.from_numpy(picked), unique


def _picks_on_device(points: Tensor, order: Tensor, count: int) -> tuple[Tensor, bool]:
    """The same loop without waiting for the device; what is launched is recorded once, since launching costs most."""
    candidates = points[order].T.contiguous()
    difference = torch.empty_like(candidates)
    far = torch.full((len(order),), _FAR, device=points.device)
    last = points[0][:, None].clone()
    picks = torch.zeros(_PICKS_PER_RECORD, dtype=torch.long, device=points.device)

    def pick() -> None:
        for slot in picks.split(1):
            torch.sub(candidates, last, out=difference)
            difference.square_()
            torch.minimum(far, difference[0].add_(difference[1]).add_(difference[2]), out=far)
            torch.argmax(far, dim=0, keepdim=True, out=slot)
            torch.index_select(candidates, 1, slot, out=last)

    pick()
    chosen = [picks.clone()]
    further = -(-(count - 1) // _PICKS_PER_RECORD) - 1
    if further > 0:
        again = _recorded(pick, points.device) if points.device.type == "cuda" else pick
        for _ in range(further):
            again()
            chosen.append(picks.clone())
    picked = torch.cat([picks.new_zeros(1), order[torch.cat(chosen)]])[:count]
    return picked, _in_order(points[picked])


def _in_order(points: Tensor) -> bool:
    """Return whether each point (n, 3) is the one that lies furthest from those before it, and no other as far."""
    difference = points[:, None] - points
    nearest = _squared(*difference.unbind(-1)).cummin(dim=0).values
    two = nearest[:-1].topk(min(2, len(points)), dim=1)
    follows = two.indices[:, 0] == torch.arange(1, len(points), device=points.device)
    return bool((follows & (two.values[:, 0] > two.values[:, -1])).all())


def _recorded(launch: Callable[[], None], device: torch.device) -> Callable[[], None]:
    """Record what a call launches on CUDA, without running it, and return the call that runs it."""
    graph, stream = torch.cuda.CUDAGraph(), torch.cuda.Stream(device)
    with torch.cuda.stream(stream):
        graph.capture_begin(capture_error_mode="thread_local")
        launch()
        graph.capture_end()
    return graph.replay


def ball_query(points: Tensor, centers: Tensor, radius: float, count: int) -> Tensor:
    """Find for every centre the first points, in their order, that lie within a ball.

    Args:
        points: (N, 3) float32 [m].
        centers: (M, 3) float32 [m].
        radius: The squared distance must be below radius * radius, both rounded to float32.
        count: So many slots; free ones repeat the first hit, or hold 0 where there is none.

    Returns:
        Indices (M, count) int64.
    """
    limit = float(np.float32(radius) * np.float32(radius))

    def hits(offsets: Tensor, _: Tensor) -> list[Tensor]:
        return [_squared(*offsets.unbind(-1)) < limit]

    return _first_hits(points, centers, radius, count, 1, hits)[0]


def cylinder_query(
    points: Tensor, centers: Tensor, rotations: Tensor, radius: float, low: float, highs: Sequence[float], count: int
) -> Tensor:
    """Find for every centre the first points, in their order, that lie within cylinders along its x axis.

    Args:
        points: (N, 3) float32 [m].
        centers: (M, 3) float32 [m].
        rotations: (M, 3, 3), columns are the axes of each cylinder's frame.
        radius: Around x; strictly within.
        low: Least local x, exclusive.
        highs: Largest local x, exclusive, one for each of D nested cylinders.
        count: As in `ball_query`.

    Returns:
        Indices (D, M, count) int64.
    """
    limit = float(np.float32(radius) * np.float32(radius))
    least, mosts = float(np.float32(low)), [float(np.float32(high)) for high in highs]

    def hits(offsets: Tensor, row: Tensor) -> list[Tensor]:
        x, y, z = turned(offsets, rotations.index_select(0, row.flatten()).unflatten(0, row.shape))
        inside = (y * y + z * z < limit) & (x > least)
        return [inside & (x < most) for most in mosts]

    reach = float(np.hypot(radius, max(abs(low), *(abs(h) for h in highs))))
    return _first_hits(points, centers, reach, count, len(highs), hits)


def turned(offsets: Tensor, rotations: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the coordinates x, y, z (...) of offsets (..., 3) in frames with axes (..., 3, 3) as columns."""
    dx, dy, dz = offsets.unbind(-1)
    x, y, z = (r[..., 1] * dy + r[..., 0] * dx + r[..., 2] * dz for r in rotations.unbind(-1))
    return x, y, z


def three_nearest(unknown: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """Find the three nearest of `known` (K, 3) for every point of `unknown` (U, 3); ties to the lower index.

    Returns:
        Squared distances (U, 3) float32, ascending, and indices (U, 3) int64.

    Raises:
        InputError: There are fewer than three known points.
    """
    if len(known) < 3:
        raise InputError(f"interpolation needs at least three known points, got {len(known)}")
    squared = torch.zeros(len(unknown), len(known), device=known.device)
    for axis in range(3):
        squared += (unknown[:, axis : axis + 1] - known[:, axis]).square_()
    distances, indices = [], []
    for _ in range(3):
        nearest = squared.argmin(dim=1, keepdim=True)
        distances.append(squared.gather(1, nearest))
        indices.append(nearest)
        squared.scatter_(1, nearest, float("inf"))
    return torch.cat(distances, 1), torch.cat(indices, 1)


def _squared(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    """Squared length of vectors, summed in the kernels' order."""
    return x * x + y * y + z * z


def _check_points(points: Tensor) -> None:
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise InputError(f"points must be (N, 3) with at least one point, got {tuple(points.shape)}")


def _first_hits(points: Tensor, centers: Tensor, reach: float, count: int, layers: int, hits: Hits) -> Tensor:
    """Give every centre its hits in every layer.

    Args:
        points: (N, 3).
        centers: (M, 3).
        reach: No hit is further from its centre.
        count: Slots.
        layers: How many answers for each centre.
        hits: Decides.

    Returns:
        Indices (layers, M, count).
    """
    _check_points(points)
    if points.device.type == "cpu":
        found, have = _scan_near(points, centers, reach, count, layers, hits)
    else:
        found, have = _scan_all(points, centers, count, layers, hits)
    free = torch.arange(count, device=points.device) >= have[..., None]
    return torch.where(free, found[..., :1], found)


def _scan_all(points: Tensor, centers: Tensor, count: int, layers: int, hits: Hits) -> tuple[Tensor, Tensor]:
    """Look at every pair, without waiting for the device; return indices (layers, M, count) and how many count."""
    n, m = len(points), len(centers)
    found = torch.zeros(layers, m, count, dtype=torch.long, device=points.device)
    have = torch.zeros(layers, m, dtype=torch.long, device=points.device)
    numbers = torch.arange(n, dtype=torch.int32, device=points.device)
    rows, step = torch.arange(m, device=points.device)[:, None], max(1, _PAIRS_PER_BLOCK // n)
    for block in (slice(start, start + step) for start in range(0, m, step)):
        for layer, hit in enumerate(hits(points - centers[block, None], rows[block])):
            first = torch.where(hit, numbers, n).topk(min(count, n), dim=1, largest=False).values
            found[layer, block, : first.shape[1]] = first
            have[layer, block] = hit.sum(dim=1)
    return found.where(found < n, 0), have


def _scan_near(
    points: Tensor, centers: Tensor, reach: float, count: int, layers: int, hits: Hits
) -> tuple[Tensor, Tensor]:
    """Look at the pairs within about `reach`, block by block until every centre has its hits in every layer."""
    device, m = points.device, len(centers)
    found = torch.zeros(layers, m, count, dtype=torch.long, device=device)
    have = torch.zeros(layers, m, dtype=torch.long, device=device)
    near = _NearPairs(points, centers, reach)
    for start in range(0, len(points), _POINTS_PER_BLOCK):
        waiting = (have < count).any(dim=0).nonzero()[:, 0]
        if len(waiting) == 0:
            break
        for rows in waiting.split(_CENTERS_PER_BLOCK):
            row, column = near.within(rows, slice(start, start + _POINTS_PER_BLOCK))
            for layer, hit in enumerate(hits(points.index_select(0, column) - centers.index_select(0, row), row)):
                hit_row, hit_column = row[hit], column[hit]
                new = torch.bincount(hit_row, minlength=m)
                before = have[layer] - torch.cumsum(new, 0) + new
                slot = torch.arange(len(hit_row), device=device) + before.index_select(0, hit_row)
                kept = slot < count
                found[layer].view(-1)[hit_row[kept] * count + slot[kept]] = hit_column[kept]
                have[layer] += new
    return found, have


class _NearPairs:
    """Pairs of centres and points that may lie within a distance of one another."""

    def __init__(self, points: Tensor, centers: Tensor, reach: float) -> None:
        middle = points.mean(dim=0)
        self._points, self._centers = points - middle, centers - middle
        squares = [v.square().sum(dim=1, keepdim=True) for v in (self._points, self._centers)]
        spread = max(float(s.max()) for s in squares if len(s))
        largest = float(points.abs().max())
        # Rounding: of the squares and products, and of the coordinates about the middle.
        self._limit = reach * reach * (1 + 1e-5) + 4e-6 * (spread + reach * largest)
        self._left = torch.cat([self._centers, squares[1], torch.ones_like(squares[1])], dim=1)
        self._right = torch.cat([-2 * self._points, torch.ones_like(squares[0]), squares[0]], dim=1)

    def within(self, rows: Tensor, block: slice) -> tuple[Tensor, Tensor]:
        """Return centre indices (K,), ascending, and point indices (K,), ascending for each of them."""
        rough = self._left[rows] @ self._right[block].T
        # numpy compares and collects several times faster than torch does on a processor.
        pair = torch.from_numpy(np.flatnonzero(rough.numpy() <= self._limit))
        row = pair // rough.shape[1]
        return rows.index_select(0, row), pair - row * rough.shape[1] + block.start
