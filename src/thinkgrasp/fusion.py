"""Several views of one scene as one: the first camera's frame, and what the others saw beyond it.

    decision = make_pipeline("offline").decide(fuse([front, side]), "the mug")

The first frame stays what it is, an image with its cloud; plans and masks are about it. The other frames add points, in
its camera's coordinates: collisions are checked against all of them, and grasps are proposed on those that belong to
the target as well.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import KDTree

from thinkgrasp.errors import ConfigError, InputError
from thinkgrasp.geometry import apply, deproject, invert, organised_normals, voxel_downsample
from thinkgrasp.types import Array, CameraIntrinsics, Degradation, Frame, OtherViews

MAX_VIEWS = 32

_SHARED_M = 0.03
"""Points of two views this near to one another, with normals that agree, may be of one surface."""
_AGREEING_COS = 0.85
_MIN_SHARED = 60
"""Points of one orientation needed to measure how far two views lie apart along it."""
_REGIONS, _MIN_IN_REGION = 3, 400
"""So many by so many parts of the image in which that is measured anew, with so many points: a view that is turned lies
too high in one part and too low in another."""
_SAME_M = 0.006
"""A point this near to the surface that the first camera saw adds nothing."""
_FREE_M, _FREE_AT_M = 0.010, 0.7
"""A point this far before what the first camera saw stands in space that it saw to be free; where that is farther away
than the second, so much farther as noise grows, with the square."""
_EDGE = 0.02
"""Relative change of depth between two neighbouring pixels that counts as an edge."""
_MAX_CONTRADICTED = 0.05
_COMPANY = 4
"""A point with fewer in four voxels around it, itself counted, is noise."""
_FALLBACK = "its points count for collisions, not for grasps"


@dataclass(frozen=True, eq=False)
class _Cloud:
    """A cloud with its normals, organised or not, in some camera's frame."""

    points: Array
    """(..., 3) [m]."""
    normals: Array
    """(..., 3)."""
    colors: NDArray[np.uint8]
    """(..., 3)."""
    edge: NDArray[np.bool_]
    """(...) beside a jump of depth, where one pixel may mix two surfaces."""

    @classmethod
    def of(cls, frame: Frame) -> _Cloud:
        points = deproject(frame.depth, frame.camera)
        z = np.nan_to_num(points[..., 2])
        low, high = (f(z, size=3, mode="nearest") for f in (ndimage.minimum_filter, ndimage.maximum_filter))
        return cls(points, organised_normals(points, frame.camera), frame.color, high - low > _EDGE * z)

    def moved(self, T: NDArray[np.float64]) -> _Cloud:
        """What was measured (N, ...), moved by T (4, 4)."""
        measured = np.isfinite(self.points[..., 2])
        points = apply(T, self.points[measured].astype(np.float64)).astype(np.float32)
        normals = (self.normals[measured] @ T[:3, :3].T).astype(np.float32)
        return _Cloud(points, normals, self.colors[measured], self.edge[measured])


def fuse(
    frames: Sequence[Frame],
    *,
    taken_s: Sequence[float] | None = None,
    max_apart_s: float = 1.0,
    voxel_m: float = 0.003,
    max_disagreement_m: float = 0.005,
) -> Frame:
    """Fuse views of one scene at rest in the first one's camera frame.

    Of the other views' points, those that the first camera or an earlier view that agrees saw as well are left out, the
    rest is thinned. A point in
    space that the first camera saw to be free is left out where it lies at an edge of its own image, since there one
    pixel mixes two depths; elsewhere it stays, for the first camera may have looked through glass.

    How far two views lie apart is measured where they see the same surface: the median distance along the normal,
    which noise does not move, for every orientation of which there is enough, in the whole image and in its parts; the
    largest counts. A shift along all surfaces that are shared cannot be seen.

    Args:
        frames: The view that plans and masks are about, then the others; all with `T_world_camera`.
        taken_s: When each was taken [s], of one clock; None = at one time.
        max_apart_s: So far may they be apart.
        voxel_m: Spacing of the points that are added.
        max_disagreement_m: Views that lie farther apart are named in `degraded`; their points count for collisions,
            not for grasps.

    Returns:
        The first frame, with `others`; the very frame where it is the only one.

    Raises:
        InputError: No frame or too many, a pose is unknown, a frame is fused already, or they were not taken at one
            time.
        ConfigError: A setting is out of range.
    """
    if not (math.isfinite(max_apart_s) and max_apart_s >= 0 and 0 < voxel_m < 0.05 and 0 < max_disagreement_m < 0.1):
        raise ConfigError(
            "fusion: need 0 <= max_apart_s, 0 < voxel_m < 0.05, 0 < max_disagreement_m < 0.1; "
            f"got {max_apart_s}, {voxel_m}, {max_disagreement_m}"
        )
    _check(frames, taken_s, max_apart_s)
    first = frames[0]
    if len(frames) == 1:
        return first
    seen = _Cloud.of(first)
    kept = seen.points[np.isfinite(seen.points[..., 2])]
    known = [KDTree(kept[voxel_downsample(kept, voxel_m)])] if len(kept) else []
    points: list[Array] = []
    normals: list[Array] = []
    colors: list[NDArray[np.uint8]] = []
    apart: list[float] = []
    complaints: list[str | None] = []
    for number, frame in enumerate(frames[1:], 2):
        cloud = _Cloud.of(frame).moved(_between(first, frame))
        meeting = _Meeting.of(seen, first.camera, cloud)
        new = np.flatnonzero(~meeting.same & ~(meeting.in_free & cloud.edge))
        new = new[_worth_adding(cloud.points[new], known, voxel_m)]
        points.append(cloud.points[new])
        normals.append(cloud.normals[new])
        colors.append(cloud.colors[new])
        apart.append(meeting.disagreement_m())
        complaints.append(_complaint(number, apart[-1], meeting.contradicted_share(cloud.edge), max_disagreement_m))
        if complaints[-1] is None and len(new):
            known.append(KDTree(points[-1]))
    others = OtherViews(
        tuple(frames[1:]),
        np.concatenate(points),
        np.concatenate(normals),
        np.concatenate(colors),
        np.repeat(np.arange(len(points), dtype=np.uint8), [len(p) for p in points]),
        tuple(apart),
        agrees=tuple(complaint is None for complaint in complaints),
        degraded=tuple(Degradation("fusion", complaint, _FALLBACK) for complaint in complaints if complaint),
    )
    return replace(first, others=others)


def describe(frame: Frame) -> str:
    """Say in one line what fusion did."""
    others = frame.others
    if others is None:
        return "one view"
    apart = ", ".join("unknown" if math.isnan(d) else f"{d * 1e3:.1f} mm" for d in others.disagreement_m)
    return f"{len(others.frames) + 1} views fused: {len(others.points)} points added; apart from the first: {apart}"


def seen_free(frame: Frame, points: NDArray[np.floating], tolerance_m: float = 0.006) -> NDArray[np.bool_]:
    """Return (N,) True where another camera of a fused frame, one that agrees, saw through a point (N, 3) of it."""
    free = np.zeros(len(points), bool)
    for other, T_other_first in agreeing_views(frame)[1:]:
        p = apply(T_other_first, np.asarray(points, np.float64))
        v, u, front = _pixels(p, other.camera)
        z = other.depth[v, u]
        free[front] |= (z > 0) & (z < np.inf) & (z - p[front, 2] > tolerance_m)
    return free


def agreeing_views(frame: Frame) -> list[tuple[Frame, NDArray[np.float64]]]:
    """Return a frame and those fused into it that agree, each with the transform (4, 4) from its camera to theirs."""
    views = [(frame, np.eye(4))]
    if frame.others is not None:
        agreeing = [f for f, agrees in zip(frame.others.frames, frame.others.agrees, strict=True) if agrees]
        views += [(f, invert(_between(frame, f))) for f in agreeing]
    return views


def _check(frames: Sequence[Frame], taken_s: Sequence[float] | None, max_apart_s: float) -> None:
    if not 1 <= len(frames) <= MAX_VIEWS:
        raise InputError(f"fusion takes 1 to {MAX_VIEWS} frames, got {len(frames)}")
    if len(frames) == 1:
        return
    for number, frame in enumerate(frames, 1):
        if frame.T_world_camera is None:
            raise InputError(
                f"view {number} of {len(frames)} has no T_world_camera; views are fused by their cameras' poses: "
                "give it in that view's camera file"
            )
        if frame.others is not None:
            raise InputError(f"view {number} of {len(frames)} is fused already; fuse frames as they were taken")
    if taken_s is None:
        return
    if len(taken_s) != len(frames) or not all(math.isfinite(t) for t in taken_s):
        raise InputError(f"taken_s must be {len(frames)} finite times, one for each frame, got {list(taken_s)}")
    late = max(taken_s) - min(taken_s)
    if late > max_apart_s:
        raise InputError(
            f"the views were taken {late:.2f} s apart (allowed {max_apart_s:g} s): what they show may have moved; "
            "read all cameras anew"
        )


def _between(first: Frame, other: Frame) -> NDArray[np.float64]:
    """T_first_other (4, 4)."""
    if first.T_world_camera is None or other.T_world_camera is None:
        raise InputError("views are fused by their cameras' poses: T_world_camera is missing in a frame")
    return invert(first.T_world_camera) @ other.T_world_camera


def _pixels(
    points: NDArray[np.floating], camera: CameraIntrinsics
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Row (K,), column (K,) and index (K,) of the points (N, 3) that fall into a camera's image."""
    front = np.flatnonzero(points[:, 2] > 0.01)
    pixel = np.rint(camera.project(points[front]))
    inside = ((pixel >= 0) & (pixel < [camera.width, camera.height])).all(axis=1)
    u, v = pixel[inside].astype(np.intp).T
    return v, u, front[inside]


@dataclass(frozen=True, eq=False)
class _Meeting:
    """How points of another view meet the surface that the first camera saw, each on the ray through it."""

    in_free: NDArray[np.bool_]
    """(N,) the point lies well before it."""
    same: NDArray[np.bool_]
    """(N,) the point lies on it."""
    doubtful: NDArray[np.bool_]
    """(N,) no surface, or the edge of one."""
    shift_m: Array
    """(K,) distance along the normal of points that may lie on the same surface."""
    normal: Array
    """(K, 3) the surface's normal there."""
    region: NDArray[np.intp]
    """(K,) the part of the first camera's image that it is in."""

    @classmethod
    def of(cls, seen: _Cloud, camera: CameraIntrinsics, cloud: _Cloud) -> _Meeting:
        points = cloud.points
        in_free, same = np.zeros((2, len(points)), bool)
        doubtful = np.ones(len(points), bool)
        v, u, index = _pixels(points, camera)
        surface, normal = seen.points[v, u], seen.normals[v, u]
        doubtful[index] = seen.edge[v, u] | np.isnan(surface[:, 2])
        limit = _FREE_M * np.maximum(1, (surface[:, 2] / _FREE_AT_M) ** 2)
        in_free[index] = surface[:, 2] - points[index, 2] > limit
        offset = points[index] - surface
        away = np.linalg.norm(offset, axis=1)
        along = np.einsum("ni,ni->n", offset, normal)
        same[index] = ((np.abs(along) <= _SAME_M) & (away <= 2 * _SAME_M)) | (away <= _SAME_M)
        shared = (np.einsum("ni,ni->n", cloud.normals[index], normal) > _AGREEING_COS) & (away <= _SHARED_M)
        shared &= ~doubtful[index]
        region = v * _REGIONS // camera.height * _REGIONS + u * _REGIONS // camera.width
        return cls(in_free, same, doubtful, along[shared].astype(np.float32), normal[shared], region[shared])

    def contradicted_share(self, edge: NDArray[np.bool_]) -> float:
        """Share of the points, edges (N,) of either view left out, that stand in space seen to be free."""
        compared = ~self.doubtful & ~edge
        return float(self.in_free[compared].mean()) if compared.any() else 0.0

    def disagreement_m(self) -> float:
        """The largest median shift along one of 26 orientations; NaN where too little is shared."""
        if len(self.shift_m) < _MIN_SHARED:
            return math.nan
        sector = np.rint(self.normal / np.abs(self.normal).max(axis=1, keepdims=True)).astype(np.int64) @ [9, 3, 1]
        everywhere = self._largest_median(sector, _MIN_SHARED)
        return float(np.fmax(everywhere, self._largest_median(sector * _REGIONS**2 + self.region, _MIN_IN_REGION)))

    def _largest_median(self, group: NDArray[np.integer], least: int) -> float:
        worst = math.nan
        for one in np.unique(group):
            shift = self.shift_m[group == one]
            if len(shift) >= least:
                worst = float(np.fmax(worst, np.abs(np.median(shift))))
        return worst


def _worth_adding(points: Array, known: Sequence[KDTree], voxel_m: float) -> NDArray[np.intp]:
    """Indices of one point per voxel of points (N, 3), without those among known ones and without lone ones."""
    chosen = voxel_downsample(points, voxel_m)
    for near in known if len(chosen) else ():
        chosen = chosen[np.isinf(near.query(points[chosen], distance_upper_bound=voxel_m)[0])]
    if len(chosen) < _COMPANY:
        return chosen[:0]
    thin = points[chosen]
    distances = KDTree(thin).query(thin, k=_COMPANY, distance_upper_bound=4 * voxel_m)[0]
    return chosen[np.isfinite(np.asarray(distances)[:, -1])]


def _complaint(number: int, apart_m: float, contradicted: float, limit_m: float) -> str | None:
    if math.isnan(apart_m):
        return f"view {number} shares no surface with the first, so that their poses cannot be checked"
    if apart_m > limit_m:
        return f"views 1 and {number} lie {apart_m * 1e3:.1f} mm apart (limit {limit_m * 1e3:g} mm): calibrate anew"
    if contradicted > _MAX_CONTRADICTED:
        return (
            f"{contradicted:.0%} of what view {number} shows stands where the first camera saw free space: "
            "something moved, or is of glass"
        )
    return None
