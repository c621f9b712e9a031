"""Which of the points that other cameras saw belong to one thing: by growing from what the first camera saw of it."""

from __future__ import annotations

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from thinkgrasp.geometry import apply, invert, voxel_downsample
from thinkgrasp.types import Mask, Proposal, Scene

Float = NDArray[np.float32]

_STEP_M = 0.006
"""From one point of a thing to the next."""
_SEED_M = 0.004
_LOWEST_M = 0.005
"""What lies nearer to the support may be the support."""
_BEYOND_BOX_M = 0.015
_BEYOND_BOX = 0.25
"""A thing may reach this far, and this share of a side, beyond the box that one view gave it."""
_MAX_DENT = 0.3
"""Where normals lean towards one another by more, two things meet."""
_LIKE_NEXT, _LIKE_THING = 0.3, 0.3
"""How much the colour may change from one point to the next, and the hue differ from the thing's own (logarithms)."""


@dataclass(frozen=True, eq=False)
class _Front:
    """The points reached last."""

    points: Float
    normals: Float
    colors: Float
    """(N, 3) lightness and two ratios, see `_compared`."""
    marks: NDArray[np.int32]

    def __getitem__(self, index: NDArray[np.intp]) -> _Front:
        return _Front(self.points[index], self.normals[index], self.colors[index], self.marks[index])


_KNOWN: WeakKeyDictionary[Scene, NDArray[np.int32]] = WeakKeyDictionary()
"""A scene is asked once for each of its things."""


def owners(scene: Scene) -> NDArray[np.int32]:
    """Return the mark (M,) of the proposal that each of the other cameras' points belongs to; 0 = of none.

    All proposals grow at once, by steps of 6 mm over points above the support, each within its box, enlarged; a point
    goes to the first that reaches it. A step leads neither over a dent nor to another colour. Points of a view that
    does not agree with the first belong to nothing.
    """
    if scene not in _KNOWN:
        _KNOWN[scene] = _grown(scene)
    return _KNOWN[scene]


def own_points(scene: Scene, mask: Mask) -> NDArray[np.intp]:
    """Return the indices of the other cameras' points on what a mask (H, W) covers: the proposal with that mask.

    None where the mask is not one of the scene's proposals, for nothing then tells the thing from its surroundings.
    """
    if scene.frame.others is None:
        return np.zeros(0, np.intp)
    mark = next((p.mark for p in scene.proposals if p.mask is mask), 0)
    return np.flatnonzero(owners(scene) == mark) if mark else np.zeros(0, np.intp)


def _grown(scene: Scene) -> NDArray[np.int32]:
    others = scene.frame.others
    if others is None:
        return np.zeros(0, np.int32)
    marks = np.zeros(len(others.points), np.int32)
    boxes = {p.mark: _inside_box(p, others.points) for p in scene.proposals}
    free = others.agreeing() & np.logical_or.reduce([np.zeros(len(marks), bool), *boxes.values()])
    if scene.support is not None:
        free &= scene.support.height(others.points) > _LOWEST_M
    everything = _Front(others.points, np.nan_to_num(others.normals), _compared(others.colors), marks)
    front = _seeds(scene)
    hues = {mark: front.colors[front.marks == mark][0, 1:] for mark in np.unique(front.marks)}
    while len(front.points) and free.any():
        left = np.flatnonzero(free)
        distance, nearest = KDTree(front.points).query(others.points[left], distance_upper_bound=_STEP_M)
        reached = np.isfinite(distance)
        left, came = left[reached], front[np.asarray(nearest)[reached]]
        ok = _goes_on(came, everything[left])
        for mark in np.unique(came.marks):
            own = np.flatnonzero(came.marks == mark)
            hue = np.linalg.norm(everything.colors[left[own], 1:] - hues[mark], axis=1)
            ok[own] &= boxes[int(mark)][left[own]] & (hue <= _LIKE_THING)
        marks[left[ok]], free[left[ok]] = came.marks[ok], False
        front = everything[left[ok]]
    return marks


def _goes_on(came: _Front, to: _Front) -> NDArray[np.bool_]:
    """(K,) True where a step keeps the colour and crosses no dent.

    References:
        Stein et al., Object partitioning using local convexity, CVPR 2014: the criterion of convex connections.
    """
    step = to.points - came.points
    length = np.maximum(np.linalg.norm(step, axis=1), 1e-6)
    bulge = np.einsum("ni,ni->n", to.normals - came.normals, step) / length
    change = np.linalg.norm(to.colors - came.colors, axis=1)
    return np.asarray((bulge >= -_MAX_DENT) & (change <= _LIKE_NEXT), np.bool_)


def _seeds(scene: Scene) -> _Front:
    """What the first camera saw of every proposal, thinned, in its median colour: outlines mix."""
    measured = np.isfinite(scene.points[..., 2])
    normals = np.zeros_like(scene.points) if scene.normals is None else np.nan_to_num(scene.normals)
    nothing = np.zeros((0, 3), np.float32)
    parts = [_Front(nothing, nothing, nothing, np.zeros(0, np.int32))]
    for p in scene.proposals:
        v, u = np.nonzero(p.mask & measured)
        chosen = voxel_downsample(scene.points[v, u], _SEED_M)
        v, u = v[chosen], u[chosen]
        marks = np.full(len(v), p.mark, np.int32)
        colors = _compared(scene.frame.color[v, u])
        colors[:] = np.median(colors, axis=0) if len(v) else 0
        parts.append(_Front(scene.points[v, u], normals[v, u], colors, marks))
    names = ("points", "normals", "colors", "marks")
    return _Front(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def _compared(colors: NDArray[np.uint8]) -> Float:
    """Lightness, which shade changes and so counts less, and the ratios of red and blue to green (N, 3): logs."""
    log = np.log(colors.astype(np.float32) + 8)
    return np.stack([0.4 * log.mean(axis=1), log[:, 0] - log[:, 1], log[:, 2] - log[:, 1]], axis=1)


def _inside_box(proposal: Proposal, points: Float) -> NDArray[np.bool_]:
    half = np.array(proposal.extents_m) / 2
    half = half + np.maximum(_BEYOND_BOX_M, _BEYOND_BOX * half)
    local = apply(invert(proposal.T_camera_object), points)
    return np.asarray((np.abs(local) <= half.astype(points.dtype)).all(axis=1), np.bool_)
