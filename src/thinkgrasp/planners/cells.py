"""Which cell of the k x k grid to take a thing by: safe, free, stable, and on the part that was asked for."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from thinkgrasp.selection import middle_cell
from thinkgrasp.types import Mask, Proposal, Scene

Float = NDArray[np.float64]

MAX_SIDE_PX = 96
"""Outlines are judged at this resolution."""
FREE_M = 0.04
"""Clearance beside a cell from which on it counts as fully free."""
MIN_COVER = 0.05
"""A cell with less of the thing in it is no choice."""
RIM_M = 0.015
"""Depth below the highest point that still counts as rim."""
HOLLOW = 0.5


@dataclass(frozen=True, eq=False)
class Outline:
    """One thing's mask around its box, thinned out to at most MAX_SIDE_PX per side."""

    mask: Mask
    """(h, w) the thing."""
    others: Mask
    """(h, w) other things that stand up beside it."""
    height: Float
    """(h, w) above the support [m]; NaN where unknown."""
    u: NDArray[np.intp]
    """(w,) image columns."""
    v: NDArray[np.intp]
    """(h,) image rows."""
    metres_per_px: float
    """Of the thinned-out grid, at the thing's distance."""

    @classmethod
    def of(cls, scene: Scene, proposal: Proposal) -> Outline:
        """Cut a proposal out of its scene, with a margin in which neighbours show."""
        x0, y0, x1, y1 = proposal.box_xyxy
        full_h, full_w = proposal.mask.shape
        distance = max(float(proposal.center_m[2]), 0.05)
        m_per_px = distance / scene.frame.camera.fx
        margin = int(np.clip(1.5 * FREE_M / m_per_px, 2, 80))
        step = max(1, -(-(max(x1 - x0, y1 - y0) + 2 * margin) // MAX_SIDE_PX))
        u = np.arange(max(x0 - margin, 0), min(x1 + margin, full_w), step)
        v = np.arange(max(y0 - margin, 0), min(y1 + margin, full_h), step)
        window = np.ix_(v, u)
        others = np.zeros((len(v), len(u)), bool)
        for other in scene.proposals:
            if other.mark != proposal.mark and other.height_m[1] > proposal.height_m[1] - 0.03:
                others |= other.mask[window]
        if scene.support is not None:
            height = scene.support.height(scene.points[window]).astype(np.float64)
        else:
            height = np.full(others.shape, np.nan)
        return cls(proposal.mask[window], others, height, u, v, m_per_px * step)


@dataclass(frozen=True)
class CellChoice:
    """The chosen cell, how good it is (0..1), and why."""

    cell: int
    score: float
    clearance_m: float
    reasons: tuple[str, ...]


def choose_cell(
    outline: Outline,
    proposal: Proposal,
    grid: int,
    *,
    take: Mask | None = None,
    avoid: Mask | None = None,
    failed: Collection[int] = (),
) -> CellChoice:
    """Choose the cell to take a thing by.

    Args:
        outline: The thing, from `Outline.of`.
        proposal: The same thing.
        grid: Cells per side.
        take: (h, w) of the outline, the part to take; None = no preference.
        avoid: (h, w) of the outline, the part to keep away from.
        failed: Cells that were tried without success.

    Returns:
        The best cell, by the mean of stability (near the middle of the outline; for hollow things on the rim),
        accessibility (clearance to neighbours as high as the thing), cover and the part's share.
    """
    mask = outline.mask
    x0, y0, x1, y1 = proposal.box_xyxy
    column = np.clip((outline.u + 0.5 - x0) / max(x1 - x0, 1) * grid, 0, grid - 1).astype(int)
    row = np.clip((outline.v + 0.5 - y0) / max(y1 - y0, 1) * grid, 0, grid - 1).astype(int)
    cell_at = row[:, None] * grid + column[None, :]
    inside = mask & ((outline.u >= x0) & (outline.u < x1))[None, :] & ((outline.v >= y0) & (outline.v < y1))[:, None]
    n = grid * grid
    if not inside.any():
        return CellChoice(middle_cell(grid), 0.0, 0.0, ("the outline is too thin to choose a cell from",))

    cells = cell_at[inside]
    count = np.bincount(cells, minlength=n).astype(float)
    area = ((x1 - x0) / grid) * ((y1 - y0) / grid) / max(float(np.diff(outline.u[:2]).sum()) or 1.0, 1.0) ** 2
    cover = count / max(area, 1.0)

    def share(region: Mask) -> Float:
        found = np.bincount(cell_at[region & inside], minlength=n).astype(float)
        return found / max(found.max(), 1.0)

    clearance = _clearance(outline)
    free = np.bincount(cells, weights=clearance[inside], minlength=n) / np.maximum(count, 1)
    access = np.clip(free / FREE_M, 0, 1)
    hollow = proposal.shape_degree("hollow") >= HOLLOW
    stable = share(rim_region(outline)) if hollow else _centrality(inside, cell_at, count, n)
    score = 0.45 * stable + 0.35 * access + 0.2 * np.clip(cover / 0.5, 0, 1)
    if take is not None and take.any():
        score = 0.4 * score + 0.6 * share(take)
    if avoid is not None and avoid.any():
        score = score * (1 - 0.8 * share(avoid))
    score = np.where(cover >= min(MIN_COVER, 0.5 * cover.max()), score, -1.0)
    for cell in failed:
        if 1 <= cell <= n:
            score[cell - 1] = max(score[cell - 1], 0.0) * 0.3
    best = int(np.argmax(score))
    where = "rim" if hollow else "middle of the outline"
    reasons = (
        f"{free[best] * 100:.1f} cm free beside it",
        f"{where} {stable[best]:.2f}",
        f"{min(cover[best], 1):.0%} of the cell is the object",
    )
    return CellChoice(best + 1, float(max(score[best], 0.0)), float(free[best]), reasons)


def _clearance(outline: Outline) -> Float:
    """(h, w) distance to the nearest neighbour [m]."""
    if not outline.others.any():
        return np.full(outline.mask.shape, 2 * FREE_M)
    distance = np.asarray(ndimage.distance_transform_edt(~outline.others), np.float64)
    return distance * outline.metres_per_px


def _centrality(inside: Mask, cell_at: NDArray[np.intp], count: Float, n: int) -> Float:
    """(n,) 1 for the cell whose pixels lie at the middle of the outline, falling off with distance."""
    v, u = np.nonzero(inside)
    spread = max(float(np.hypot(u.std(), v.std())), 1e-6)
    distance = np.hypot(u - u.mean(), v - v.mean()) / spread
    mean = np.bincount(cell_at[inside], weights=distance, minlength=n) / np.maximum(count, 1)
    return np.exp(-(mean**2) / 2)


def rim_region(outline: Outline) -> Mask:
    """Return (h, w) the pixels near the thing's highest point; its outermost band where heights are unknown."""
    heights = outline.height[outline.mask]
    heights = heights[np.isfinite(heights)]
    if len(heights):
        return outline.mask & (outline.height >= np.percentile(heights, 97) - RIM_M)
    inner = np.asarray(ndimage.distance_transform_edt(np.pad(outline.mask, 1)), np.float64)[1:-1, 1:-1]
    return outline.mask & (inner <= max(0.2 * inner.max(), 1.5))


def part_region(outline: Outline, place: str) -> Mask | None:
    """Find a part in a thing's outline.

    Args:
        outline: The thing.
        place: wide or thin (end of a long thing), middle, protrusion, rim, top or bottom.

    Returns:
        (h, w) the part's pixels; None where the outline does not show it (no handle in view, ends that look alike).
    """
    mask = outline.mask
    if mask.sum() < 12:
        return None
    if place == "rim":
        return rim_region(outline)
    if place == "protrusion":
        return _protrusion(mask)
    if place in ("top", "bottom"):
        return _by_height(outline, place)
    return _along_axis(mask, place)


def _by_height(outline: Outline, place: str) -> Mask | None:
    height = np.where(outline.mask, outline.height, np.nan)
    known = height[np.isfinite(height)]
    if len(known) and np.ptp(np.percentile(known, [3, 97])) > 0.03:
        low, high = np.percentile(known, [3, 97])
        cut = low + (0.7 if place == "top" else 0.3) * (high - low)
        return outline.mask & ((height >= cut) if place == "top" else (height <= cut))
    return None


def _protrusion(mask: Mask) -> Mask | None:
    padded = np.pad(mask, 1)
    inner = np.asarray(ndimage.distance_transform_edt(padded), np.float64)
    radius = 0.55 * float(inner.max())
    core = inner > radius
    body = np.asarray(ndimage.distance_transform_edt(~core), np.float64) <= radius + 1.5
    labels, n = ndimage.label(padded & ~body)  # pyright: ignore[reportGeneralTypeIssues]
    if n == 0:
        return None
    sizes = np.bincount(np.ravel(labels))[1:]
    largest = int(sizes.argmax())
    if sizes[largest] < max(0.015 * mask.sum(), 4):
        return None
    return np.asarray(labels == largest + 1)[1:-1, 1:-1]


def _along_axis(mask: Mask, place: str) -> Mask | None:
    v, u = np.nonzero(mask)
    xy = np.stack([u - u.mean(), v - v.mean()], axis=1)
    values, vectors = np.linalg.eigh(xy.T @ xy / len(xy))
    t = xy @ vectors[:, 1]
    t = (t - t.min()) / max(float(np.ptp(t)), 1e-6)
    if place == "middle":
        chosen = np.abs(t - 0.5) < 0.18
    else:
        if np.sqrt(values[1] / max(values[0], 1e-6)) < 1.4:
            return None
        first, last = float((t < 0.35).sum()), float((t > 0.65).sum())
        if max(first, last) < 1.1 * min(first, last):
            return None
        chosen = t < 0.35 if (first > last) == (place == "wide") else t > 0.65
    region = np.zeros_like(mask)
    region[v[chosen], u[chosen]] = True
    return region
