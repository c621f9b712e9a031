"""Things that depth does not see: clear or shiny ones that leave a hole, and flat ones that lie on the support."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from thinkgrasp.geometry import Float
from thinkgrasp.perception.foreground import Foreground
from thinkgrasp.perception.morphology import Labels, connected_areas
from thinkgrasp.perception.support import Support
from thinkgrasp.types import Array, CameraIntrinsics

MIN_PIXELS = 150
MIN_WIDTH_PX = 7
CONTRAST = 10.0
COLORED_SHARE = 0.3
MAX_SIDE_M = 0.3


def find_blind(
    labels: Labels, foreground: Foreground, points: Array, support: Support, camera: CameraIntrinsics
) -> tuple[Labels, Array]:
    """Add things that stand out in colour where depth shows a hole or the bare surface.

    Args:
        labels: (H, W) things found so far, 1..n.
        foreground: Heights and colour contrast.
        points: (H, W, 3) [m]; NaN = no return.
        support: The surface.
        camera: Intrinsics at this size.

    Returns:
        Labels with the new things appended, and a copy of the points in which their missing depth is that of an upright
        card that stands where the thing's lowest pixel meets the support: good for size, not for grasping.
    """
    blank = (labels == 0) & (foreground.region & (np.abs(foreground.height) < 0.012) | ~np.isfinite(points[..., 2]))
    candidate = blank & (foreground.contrast > foreground.usual_contrast + CONTRAST)
    if candidate.sum() < MIN_PIXELS:
        return labels, points
    candidate = ndimage.binary_closing(candidate, iterations=2) & blank
    candidate = ndimage.binary_opening(candidate, iterations=MIN_WIDTH_PX // 2)
    candidate &= ~ndimage.binary_dilation(labels > 0, iterations=4).astype(bool)
    blobs, _ = connected_areas(candidate)
    out, filled = labels.copy(), points
    known = int(labels.max())
    for i, box in enumerate(ndimage.find_objects(blobs), start=1):
        mask = blobs[box] == i
        solid = ndimage.binary_fill_holes(mask) & blank[box]
        if solid.sum() < MIN_PIXELS or mask.sum() < COLORED_SHARE * solid.sum() or _touches_image(box, labels.shape):
            continue
        card = _card(_rays(box, camera), solid, support)
        if card is None:
            continue
        missing = solid & ~np.isfinite(points[box][..., 2])
        known += 1
        out[box][solid] = known
        if missing.any():
            filled = filled.copy() if filled is points else filled
            filled[box][missing] = card[missing]
    return out, filled


def _rays(box: tuple[slice, slice], camera: CameraIntrinsics) -> Float:
    """Viewing directions (h, w, 3) of the pixels of a box, z = 1."""
    v, u = np.mgrid[box]
    return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)


def _touches_image(box: tuple[slice, slice], shape: tuple[int, ...]) -> bool:
    return box[0].start == 0 or box[1].start == 0 or box[0].stop == shape[0] or box[1].stop == shape[1]


def _card(rays: Float, mask: NDArray[np.bool_], support: Support) -> Array | None:
    """Points (h, w, 3) of an upright card that faces the camera and stands on the support below the mask.

    None when the mask's foot does not lie on the support or the card would be larger than MAX_SIDE_M.
    """
    normal, offset = support.plane.normal, support.plane.offset_m
    rows = np.flatnonzero(mask.any(axis=1))
    foot = rays[rows[-1]][mask[rows[-1]]].mean(axis=0)
    down = float(foot @ normal)
    if down > -0.05:
        return None
    stand = foot * (-offset / down)
    if support.distance_outside(stand[None].astype(np.float32))[0] > 0:
        return None
    level = stand - normal * float(stand @ normal)
    facing = level / np.linalg.norm(level)
    along = rays @ facing
    with np.errstate(divide="ignore", invalid="ignore"):
        card = rays * (float(stand @ facing) / along)[..., None]
    extent = card[mask]
    if not np.isfinite(extent).all() or np.ptp(extent, axis=0).max() > MAX_SIDE_M:
        return None
    return card.astype(np.float32)
