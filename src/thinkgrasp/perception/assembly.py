"""From groups of patches to whole things: hollow bodies, parts that float, crumbs, and pixels without depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from thinkgrasp.perception.color import color_memberships
from thinkgrasp.perception.edges import Edges, count_pairs, find_edges, tabulate
from thinkgrasp.perception.foreground import Foreground
from thinkgrasp.perception.morphology import Labels, Nearest, nearest_area, pixels_by_label
from thinkgrasp.perception.shape import Circle, circle_from_normals
from thinkgrasp.perception.support import Support
from thinkgrasp.types import Array

MIN_AREA_M2 = 1.2e-4
CONCAVE_BULGE = -0.3
"""Below, a body is surely seen from inside."""


@dataclass(frozen=True, eq=False)
class _Body:
    """A group's points, subsampled."""

    pixels: int
    xy: NDArray[np.float64]
    """(m, 2) in the support's axes [m]"""
    height: NDArray[np.float64]
    """(m,) [m]"""
    lab: NDArray[np.float64]
    """(3,) median"""
    colors: NDArray[np.float64]
    """(11,) shares of the colour names"""
    facing: float
    """Median cosine between normal and line of sight"""
    bulge: float
    """Mean outwardness of the horizontal normals as seen from the body's own middle: > 0 convex, < 0 concave."""
    circle: Circle | None
    """Around the vertical axis that the side faces share."""

    @property
    def top(self) -> float:
        return float(np.percentile(self.height, 97))

    @property
    def bottom(self) -> float:
        return float(np.percentile(self.height, 3))


def assemble(
    labels: Labels, foreground: Foreground, points: Array, normals: Array, lab: Array, support: Support
) -> tuple[Labels, Edges]:
    """Join what one thing was cut into, and drop what is no thing.

    Args:
        labels: Groups of patches (H, W), 1..n.
        foreground: Heights and colour contrast.
        points: (H, W, 3) [m].
        normals: (H, W, 3) unit.
        lab: (H, W, 3) CIE Lab.
        support: The surface.

    Returns:
        Labels (H, W) 1..m, with pixels without depth where they belong to a thing, and the borders of the groups.
    """
    nearest = nearest_area(labels)
    edges = find_edges(labels, points, normals, reach_px=3, blind_reach_px=15, nearest=nearest)
    labels = _join(labels, edges, points, normals, lab, support)
    labels = _drop_artefacts(labels, foreground, points, normals)
    return _claim_missing(labels, nearest, foreground, lab), edges


def _join(labels: Labels, edges: Edges, points: Array, normals: Array, lab: Array, support: Support) -> Labels:
    n = int(labels.max())
    if n < 2:
        return labels
    contact, front = tabulate(edges, n)
    blind = count_pairs(edges.a[edges.blind], edges.b[edges.blind], n)
    blind = blind + blind.T
    bodies = [_body(own, points, normals, lab, support) for own in pixels_by_label(labels)]
    group = np.arange(n)
    for i in np.argsort([b.pixels for b in bodies], kind="stable"):
        meets = contact[i] + front[i] + front[:, i]
        for j in np.argsort(-meets, kind="stable"):
            if meets[j] < 4 or group[i] == group[j]:
                continue
            border = _Border(int(meets.sum()), int(contact[i, j]), int(front[i, j]), int(front[j, i]), int(blind[i, j]))
            joined = any(rule(bodies[i], bodies[j], border) for rule in RULES)
            # An inside may touch nothing but a rim that has been joined to its outside already.
            outsides = np.flatnonzero(group == group[j])
            if joined or any(_is_interior(bodies[i], bodies[k], border) for k in outsides if k != j):
                group[group == group[i]] = group[j]
                break
    new = np.unique(group, return_inverse=True)[1].astype(np.int32) + 1
    return np.where(labels > 0, np.r_[np.int32(0), new][labels], 0).astype(np.int32)


@dataclass(frozen=True)
class _Border:
    """How a part meets a body [px]."""

    total: int
    """Of the part, towards anything."""
    contact: int
    in_front: int
    behind: int
    blind: int
    """Across pixels without depth."""


def _body(pixels: NDArray[np.intp], points: Array, normals: Array, lab: Array, support: Support) -> _Body:
    index = pixels[:: max(1, len(pixels) // 200)]
    p = points.reshape(-1, 3)[index].astype(np.float64)
    n = np.nan_to_num(normals.reshape(-1, 3)[index].astype(np.float64))
    xy, normal_xy = support.footprint(p).astype(np.float64), support.footprint(n).astype(np.float64)
    out = xy - (xy.min(axis=0) + xy.max(axis=0)) / 2
    out /= np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-6)
    facing = -(n * p).sum(1) / np.linalg.norm(p, axis=1)
    trusted = facing > 0.25
    return _Body(
        len(pixels),
        xy,
        support.plane.height(p).astype(np.float64),
        np.median(lab.reshape(-1, 3)[index], axis=0).astype(np.float64),
        color_memberships(lab.reshape(-1, 3)[index]).mean(axis=0).astype(np.float64),
        float(np.median(facing)),
        float((out * normal_xy).sum(1).mean()),
        circle_from_normals(xy[trusted], normal_xy[trusted]),
    )


def _is_interior(inner: _Body, outer: _Body, border: _Border) -> bool:
    """Whether `inner` is the inside of the hollow thing whose outside is `outer`.

    Two things cannot stand in one place: what lies within the circle that the outer wall describes, does not rise above
    its rim and does not bulge is the inner wall or the bottom. What bulges is a thing that lies in it.
    """
    shared = border.contact + border.behind
    if shared < (0.1 if inner.bulge < 0 else 0.3) * border.total or inner.bulge > 0.55:
        return False
    circle = outer.circle
    if circle is None or inner.top > outer.top + 0.02:
        return False
    if inner.bulge > CONCAVE_BULGE and inner.bottom < outer.bottom - 0.01:
        return False  # a concave one may reach lower than what is seen of its outside: a bowl that overhangs
    within = np.linalg.norm(inner.xy - circle.center, axis=1) < 1.15 * circle.radius
    return float(within.mean()) > 0.65


def _is_flank(flank: _Body, body: _Body, border: _Border) -> bool:
    """Whether `flank` is a side of `body` that is seen at such a slant that its depth cannot be trusted."""
    if flank.facing > 0.35 or border.behind + border.contact < 0.3 * border.total:
        return False
    return _shared_colors(flank, body) > 0.65


def _is_attached(part: _Body, body: _Body, border: _Border) -> bool:
    """Whether `part` (a handle, a lid, a crumb) hangs on `body`: small, in contact, and not standing on the support."""
    if border.contact < 4:
        return False
    floats = part.bottom > 0.012 and part.bottom > body.bottom + 0.006
    alike = float(np.linalg.norm((part.lab - body.lab) * [0.4, 1, 1])) < 12
    if border.contact < border.in_front + border.behind:  # a handle stands out except where it is joined
        return part.pixels < 0.25 * body.pixels and floats and alike and _is_beside(part, body)
    return part.pixels < 0.08 * body.pixels or (part.pixels < 0.35 * body.pixels and floats and alike)


def _is_beside(part: _Body, body: _Body) -> bool:
    """Whether most of `part` lies outside the ellipse around the body's footprint."""
    low, high = body.xy.min(axis=0), body.xy.max(axis=0)
    offset = (part.xy - (low + high) / 2) / np.maximum((high - low) / 2, 1e-6)
    return float((np.linalg.norm(offset, axis=1) > 1).mean()) > 0.5


def _is_continued(part: _Body, body: _Body, border: _Border) -> bool:
    """Whether the two are one surface of one paint that missing depth has cut in two."""
    if border.blind < max(8, 0.5 * (border.contact + border.in_front + border.behind)):
        return False
    return border.contact > 2 * (border.in_front + border.behind) and _shared_colors(part, body) > 0.8


RULES = (_is_interior, _is_flank, _is_attached, _is_continued)


def _shared_colors(a: _Body, b: _Body) -> float:
    return float(np.minimum(a.colors, b.colors).sum())


def _drop_artefacts(labels: Labels, foreground: Foreground, points: Array, normals: Array) -> Labels:
    """Drop what only looks like a thing: fringes of smeared depth, bumps of the surface itself, specks."""
    n = int(labels.max())
    if n == 0:
        return labels
    area = np.bincount(labels.ravel(), minlength=n + 1)
    core = np.bincount(labels[ndimage.minimum_filter(labels, 5) == labels].ravel(), minlength=n + 1)
    facing, z, height, contrast = np.zeros((4, n + 1))
    for i, own in enumerate(pixels_by_label(labels), start=1):
        own = own[:: max(1, len(own) // 400)]
        p, m = points.reshape(-1, 3)[own], normals.reshape(-1, 3)[own]
        facing[i] = np.nanmedian(-(p * np.nan_to_num(m)).sum(axis=1) / np.linalg.norm(p, axis=1))
        z[i] = np.nanmedian(p[:, 2])
        height[i] = np.nanmax(foreground.height.ravel()[own])
        contrast[i] = np.median(foreground.contrast.ravel()[own])
    area_m2 = area * (z / np.hypot(*labels.shape)) ** 2
    speck = (area < 80) | (core < 0.12 * area) | (area_m2 < MIN_AREA_M2)
    smear = (facing < 0.35) & (area_m2 < 15 * MIN_AREA_M2)
    bump = (height < 0.03) & (contrast < foreground.usual_contrast) & (area_m2 < 15 * MIN_AREA_M2)
    keep = ~(speck | smear | bump)
    keep[0] = False
    new = np.where(keep, np.cumsum(keep), 0).astype(np.int32)
    return new[labels]


def _claim_missing(labels: Labels, nearest: Nearest, foreground: Foreground, lab: Array, reach_px: int = 25) -> Labels:
    """Give pixels without depth, or too low to be told from the surface, to the thing beside them.

    They must differ in colour from the surface, look like the thing's nearest pixel and be no further than `reach_px`
    from it; enclosed ones (a bowl's bottom) need differ from the surface only.
    """
    if not labels.any():
        return labels
    usual = foreground.usual_contrast
    blind = ~np.isfinite(foreground.height)
    differs = (labels == 0) & np.where(
        blind, foreground.contrast > usual + 6, foreground.region & (foreground.contrast > usual + 12)
    )
    near = np.flatnonzero(differs & (nearest.distance_px <= reach_px))
    source = nearest.pixel.ravel()[near]
    near, source = near[labels.flat[source] > 0], source[labels.flat[source] > 0]
    flat_lab = lab.reshape(-1, 3)
    alike = np.linalg.norm(flat_lab[near] - flat_lab[source], axis=1) < 30
    near, source = near[alike], source[alike]
    candidate = np.zeros(labels.size, bool)
    candidate[near] = True
    reached = ndimage.binary_propagation(labels > 0, mask=candidate.reshape(labels.shape) | (labels > 0))
    linked = reached.astype(bool).ravel()[near]
    out = labels.copy()
    out.flat[near[linked]] = labels.flat[source[linked]]
    for i, box in enumerate(ndimage.find_objects(out), start=1):
        window = out[box] == i
        holes = ndimage.binary_fill_holes(window) & (out[box] == 0) & (foreground.contrast[box] > usual)
        out[box][holes] = i
    return out
