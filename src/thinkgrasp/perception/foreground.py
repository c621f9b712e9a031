"""Which pixels belong to things on the support, and not to the support, the floor or the background."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from thinkgrasp.perception.morphology import connected_areas
from thinkgrasp.perception.support import Support
from thinkgrasp.types import Array, Mask

OUTSIDE_MARGIN_M = 0.015
MAX_HEIGHT_M = 0.5
MIN_PIXELS = 50


@dataclass(frozen=True, eq=False)
class Foreground:
    """The region above the support."""

    mask: Mask
    """(H, W) things, with depth."""
    region: Mask
    """(H, W) everything above the support's outline, the support's own surface included."""
    height: Array
    """(H, W) [m] above the support; NaN = no return."""
    contrast: Array
    """(H, W) colour difference [Delta E] to the support's colour around the pixel."""
    usual_contrast: float
    """What nearly all of the surface's own pixels stay below: twice their upper quartile."""


def find_foreground(points: Array, lab: Array, support: Support, workspace: Mask | None) -> Foreground:
    """Separate things from the surface they stand on.

    A pixel is a thing where it rises clearly above the surface, or less clearly but in another colour than the surface
    around it (a marker that lies flat).

    Args:
        points: (H, W, 3) [m], camera frame; NaN = no return.
        lab: (H, W, 3) CIE Lab.
        support: The surface.
        workspace: (H, W) where grasping is allowed; None = everywhere.
    """
    height = support.plane.height(points)
    with np.errstate(invalid="ignore"):
        region = (height > -0.02) & (height < MAX_HEIGHT_M)
        inside = support.distance_outside(points[::2, ::2]) < OUTSIDE_MARGIN_M
        region &= inside.repeat(2, axis=0).repeat(2, axis=1)[: region.shape[0], : region.shape[1]]
        noise = 1.4826 * support.plane.residual_m
        surface = region & (np.abs(height) < 0.006 + 2 * noise)
        contrast = _contrast(lab, surface)
        usual = max(5.0, 2 * float(np.percentile(contrast[surface], 75))) if surface.any() else 5.0
        if workspace is not None:
            region &= workspace
        clear, slight = max(0.007, 4.5 * noise), max(0.004, 2.5 * noise)
        mask = region & ((height > clear) | ((height > slight) & (contrast > usual + 6)))
    mask = ndimage.binary_opening(mask, iterations=1).astype(bool)
    labels, n = connected_areas(mask)
    if n:
        mask = (np.bincount(labels.ravel()) >= MIN_PIXELS)[labels] & mask
    return Foreground(mask, region, height, contrast, usual)


def flying_pixels(points: Array, steepness: float = 5.0) -> Mask:
    """Find pixels (H, W) that hang between a thing's edge and what is behind it: steep on both sides of the pixel.

    Args:
        points: (H, W, 3) [m].
        steepness: Slope of depth over sideways distance above which a surface cannot be measured (5 is 79 degrees).
    """
    z = points[..., 2]
    flying = np.zeros(z.shape, bool)
    for axis in (0, 1):
        side = points[..., 1 - axis]
        slope = np.abs(np.diff(z, axis=axis)) > steepness * np.abs(np.diff(side, axis=axis))
        middle = (slice(1, -1), slice(None)) if axis == 0 else (slice(None), slice(1, -1))
        flying[middle] |= (slope[:-1] & slope[1:]) if axis == 0 else (slope[:, :-1] & slope[:, 1:])
    return flying


def _contrast(lab: Array, surface: Mask, block: int = 8) -> Array:
    """Colour difference of every pixel to the surface's colour around it; lightness counts less (shadows).

    Far from any surface the surface's overall colour is taken.
    """
    h, w = surface.shape
    block = min(block, h, w)
    H, W = h // block, w // block
    weight = surface[: H * block, : W * block].reshape(H, block, W, block).sum((1, 3)).astype(np.float32)
    total = np.where(surface[..., None], lab, 0)[: H * block, : W * block].reshape(H, block, W, block, 3).sum((1, 3))
    overall = total.sum((0, 1)) / max(float(weight.sum()), 1e-6)
    share = ndimage.gaussian_filter(weight, 5) + 1e-3
    local = np.stack([ndimage.gaussian_filter(total[..., c], 5) for c in range(3)], axis=-1) + 1e-3 * overall
    local /= share[..., None]
    rows = np.minimum(np.arange(h) // block, H - 1)
    columns = np.minimum(np.arange(w) // block, W - 1)
    square = np.zeros((h, w), np.float32)
    for c, weight in enumerate((0.4, 1.0, 1.0)):
        square += (np.float32(weight) * (lab[..., c] - local[..., c].astype(np.float32)[rows[:, None], columns])) ** 2
    return np.sqrt(square)
