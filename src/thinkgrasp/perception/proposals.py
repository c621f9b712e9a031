"""From labelled pixels to proposals: mask, box, size, colour, shape, confidence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage

from thinkgrasp.geometry import Float, make_transform
from thinkgrasp.perception.color import name_colors
from thinkgrasp.perception.foreground import flying_pixels
from thinkgrasp.perception.morphology import Labels, connected_areas
from thinkgrasp.perception.shape import Shape, Surface, describe_shape
from thinkgrasp.perception.support import Support
from thinkgrasp.types import Array, CameraIntrinsics, Mask, Proposal

MAX_POINTS = 500
MAX_SIDE_M = 0.6
BORDER_PX = 2
CELL_M = 0.008
SURFACE_M = 0.004
"""Lower points may be the support, seen through a hole or beside the thing."""
MIN_FACING = 0.3
"""Cosine between normal and line of sight below which depth is smear rather than surface."""


def make_proposals(
    labels: Labels,
    scale: int,
    points: Array,
    measured: Mask,
    normals: Array,
    lab: Array,
    support: Support,
    camera: CameraIntrinsics,
) -> tuple[Proposal, ...]:
    """Describe every labelled thing and number them from 1 in reading order.

    Args:
        labels: (h, w) 1..n at working resolution.
        scale: Image pixels per working pixel.
        points: (h, w, 3) [m] at working resolution.
        measured: (h, w) where the points come from the sensor and not from an assumption.
        normals: (h, w, 3).
        lab: (h, w, 3).
        support: The surface.
        camera: Of the full image.
    """
    found: list[Proposal] = []
    axes = support.axes
    origin = -support.plane.offset_m * support.plane.normal
    size = (camera.height, camera.width)
    flying = flying_pixels(points)
    for label, box in enumerate(ndimage.find_objects(labels), start=1):
        if box is None:
            continue
        small = labels[box] == label
        seen = small & np.isfinite(points[box][..., 2])
        solid = _solid(small, seen, _slanted(points[box], normals[box]) | flying[box])
        if solid.sum() < 20:
            continue
        index = np.flatnonzero(solid)[:: max(1, int(solid.sum()) // MAX_POINTS)]
        p = points[box].reshape(-1, 3)[index].astype(np.float64)
        n = np.nan_to_num(normals[box].reshape(-1, 3)[index].astype(np.float64))
        local = (p - origin) @ axes.T
        body = _without_strays(local)
        local, n = local[body], n[body]
        away = local[:, :2].mean(axis=0) - (-origin @ axes.T)[:2]
        toward_camera = -away / max(float(np.linalg.norm(away)), 1e-6)
        shape = describe_shape(Surface(local, n @ axes.T), toward_camera)
        if shape.extents[0] > MAX_SIDE_M:
            continue
        mask = _full_size(small, box, scale, size)
        y0, x0 = box[0].start * scale, box[1].start * scale
        y1, x1 = min(box[0].stop * scale, size[0]), min(box[1].stop * scale, size[1])
        border = x0 < BORDER_PX or y0 < BORDER_PX or x1 > size[1] - BORDER_PX or y1 > size[0] - BORDER_PX
        core = ndimage.binary_erosion(small, iterations=2).astype(bool)
        inner = core if core.sum() > 60 else small
        found.append(
            Proposal(
                mark=0,
                mask=mask,
                box_xyxy=(x0, y0, x1, y1),
                extents_m=(float(shape.extents[0]), float(shape.extents[1]), float(shape.extents[2])),
                T_camera_object=_pose(shape, axes, origin),
                height_m=(float(np.percentile(local[:, 2], 2)), float(np.percentile(local[:, 2], 98.5))),
                colors=name_colors(lab[box][inner][:: max(1, int(inner.sum()) // MAX_POINTS)]),
                shapes=shape.descriptors,
                touches_border=border,
                confidence=_confidence(small, small & measured[box], shape, border),
            )
        )
    return tuple(_numbered(found))


def _slanted(points: Array, normals: Array) -> Mask:
    with np.errstate(invalid="ignore"):
        return ~(-(points * normals).sum(axis=2) / np.linalg.norm(points, axis=2) > MIN_FACING)


def _solid(mask: Mask, seen: Mask, slanted: Mask) -> Mask:
    """Pixels whose depth can be trusted: not at the outline, where depth is smeared towards the background."""
    trusted = seen & ~slanted
    if trusted.sum() < 0.4 * seen.sum():
        trusted = seen
    for iterations in (3, 2, 1):
        core = trusted & ndimage.binary_erosion(mask, iterations=iterations).astype(bool)
        if core.sum() > 0.55 * trusted.sum():
            return core
    return trusted


def _without_strays(local: Float) -> Mask:
    """Points (N,) bool that form the thing: above the surface, in footprint patches of a tenth of them or more."""
    above = local[:, 2] > SURFACE_M
    if above.sum() < max(20, 0.5 * len(above)):
        above = np.ones(len(local), bool)
    cell = np.floor((local[:, :2] - local[above, :2].min(axis=0)) / CELL_M).astype(int) + 1
    inside = above & (cell < MAX_SIDE_M * 3 / CELL_M).all(axis=1)
    count = np.zeros(cell[inside].max(axis=0) + 2, int)
    np.add.at(count, (cell[inside, 0], cell[inside, 1]), 1)
    dense = count >= max(1, 0.2 * float(np.median(count[count > 0])))
    patches, n = connected_areas(dense, diagonal=True)
    weight = ndimage.sum_labels(count, patches, np.arange(n + 1))
    weight[0] = 0
    kept = inside.copy()
    kept[inside] = (weight >= 0.1 * weight.max())[patches[cell[inside, 0], cell[inside, 1]]]
    return kept if kept.sum() >= 20 else above


def _full_size(small: Mask, box: tuple[slice, slice], scale: int, size: tuple[int, int]) -> Mask:
    mask = np.zeros(size, bool)
    block = small.repeat(scale, axis=0).repeat(scale, axis=1)
    rows = slice(box[0].start * scale, min(box[0].stop * scale, size[0]))
    columns = slice(box[1].start * scale, min(box[1].stop * scale, size[1]))
    mask[rows, columns] = block[: rows.stop - rows.start, : columns.stop - columns.start]
    return mask


def _pose(shape: Shape, axes: Float, origin: Float) -> Float:
    return make_transform(axes.T @ shape.axes, axes.T @ shape.center + origin)


def _confidence(mask: Mask, seen: Mask, shape: Shape, border: bool) -> float:
    """A whole thing is compact, has depth nearly everywhere, has the size of a thing, and is not cut off."""
    perimeter = mask.sum() - ndimage.binary_erosion(mask).sum()
    compact = min(1.0, 3.2 * float(np.sqrt(mask.sum())) / max(float(perimeter), 1.0))
    depth = float(seen.sum() / mask.sum())
    size = min(1.0, float(shape.extents[1]) / 0.02) * (1.0 if shape.extents[0] < 0.35 else 0.6)
    return round(compact * (0.5 + 0.5 * depth) * size * (0.7 if border else 1.0), 3)


def _numbered(found: list[Proposal]) -> list[Proposal]:
    """Number proposals in reading order of their boxes' centres."""

    def reading_order(p: Proposal) -> tuple[float, float]:
        x0, y0, x1, y1 = p.box_xyxy
        return ((y0 + y1) / 2, (x0 + x1) / 2)

    return [replace(p, mark=i) for i, p in enumerate(sorted(found, key=reading_order), start=1)]
