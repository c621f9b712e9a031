"""The surface of one object as far as the views tell: what is seen, and what symmetry and the support say of the rest.

Two sources complete the seen points, and neither may enter space that a camera saw to be free:
the object turned by half a turn about its vertical axis (boxes, cans, balls, bowls, boxes on their side), and a curtain
that hangs from the occluding contour down to the support (anything that is not undercut).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import KDTree

from thinkgrasp.fusion import seen_free
from thinkgrasp.generators.other_views import own_points
from thinkgrasp.geometry import voxel_downsample
from thinkgrasp.gripper import Gripper
from thinkgrasp.types import Mask, Scene

Float = NDArray[np.float32]

_FREE_TOLERANCE_M = 0.006
_MAX_VIOLATION = 0.08
_CURTAIN_STEP_M = 0.006
_CURTAIN_DEPTH_M = 0.08
_TURN_OFFSETS_M = (0.002, 0.009)
_MAX_ROUND_M = 0.06
_OBSTACLE_SPACING_M = 0.007


@dataclass(frozen=True, eq=False)
class Upright:
    """Directions that grasping is measured against, camera frame."""

    up: Float
    """(3,) unit; the support's normal, or back along the view where no support is known."""
    away: Float
    """(3,) unit, perpendicular to `up`, pointing away from the camera."""
    offset_m: float
    """Height of the camera's origin above the support; inf where no support is known."""

    def height(self, points: Float) -> Float:
        """Height (N,) [m] of points (N, 3) above the support; inf where no support is known."""
        return points @ self.up + np.float32(self.offset_m)

    @classmethod
    def of(cls, scene: Scene, points: Float) -> Upright:
        """Take the support's normal, or the view onto these points (N, 3) where there is no support."""
        view = points.mean(axis=0)
        view = view / np.linalg.norm(view)
        if scene.support is None:
            up, offset = -view, np.inf
        else:
            up, offset = scene.support.normal.astype(np.float32), scene.support.offset_m
        away = view - (view @ up) * up
        if np.linalg.norm(away) < 0.05:
            down_image = np.array([0, -1, 0], np.float32)
            away = down_image - (down_image @ up) * up
        return cls(up.astype(np.float32), (away / np.linalg.norm(away)).astype(np.float32), float(offset))


@dataclass(frozen=True, eq=False)
class Surface:
    """Oriented points of one object, seen ones first."""

    points: Float
    """(N, 3) [m]."""
    normals: Float
    """(N, 3) unit, outward."""
    seen: NDArray[np.bool_]
    """(N,) measured by a camera, not inferred."""
    wanted: NDArray[np.bool_]
    """(N,) seen inside the crop, or inferred from such a point."""

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, eq=False)
class Completed:
    """One object: what was seen of it, and what can be said of the whole."""

    seen: Surface
    whole: Surface
    upright: Upright

    @classmethod
    def of(cls, scene: Scene, mask: Mask, crop: Mask, *, max_points: int, voxel_m: float) -> Completed | None:
        """Sample an object under `mask` and complete it; None where too little was seen. Arguments: `seen_surface`."""
        seen = seen_surface(scene, mask, crop, max_points, voxel_m)
        if seen is None:
            return None
        upright = Upright.of(scene, seen.points)
        turned = half_turn(scene, seen, upright)
        curtain = contour_curtain(scene, mask, crop, seen, upright, 120, extrapolate=turned is None)
        inferred = [turned, curtain] if turned is not None else [curtain]
        return cls(seen, join([seen, *(_not_free(scene, part) for part in inferred)]), upright)

    def off_centre(self, points: Float) -> Float:
        """Return how far (N,) points (N, 3) lie from the object's middle: 0..1, 1 = half its diagonal or more."""
        low, high = np.quantile(self.whole.points, 0.02, axis=0), np.quantile(self.whole.points, 0.98, axis=0)
        size = max(float(np.linalg.norm(high - low)) / 2, 0.01)
        return np.minimum(np.linalg.norm(points - (low + high) / 2, axis=1) / size, 1)

    def obstacles(self, scene: Scene, mask: Mask, gripper: Gripper) -> Float:
        """Return points (M, 3) [m], about 7 mm apart, of the object and of what stands within the gripper's reach."""
        own = self.whole.points[voxel_downsample(self.whole.points, _OBSTACLE_SPACING_M)]
        return np.concatenate([own, _surroundings(scene, mask, self.seen.points, self.upright, gripper)])


def _surroundings(scene: Scene, mask: Mask, points: Float, upright: Upright, gripper: Gripper) -> Float:
    """Seen points (M, 3) outside `mask` that stand above the support within the gripper's reach of the object."""
    stride = max(1, scene.frame.camera.width // 160)
    grid = (slice(None, None, stride), slice(None, None, stride))
    cloud, outside = scene.points[grid].reshape(-1, 3), ~mask[grid].reshape(-1)
    if scene.frame.others is not None:
        more = np.ones(len(scene.frame.others.points), bool)
        more[own_points(scene, mask)] = False
        cloud, outside = np.concatenate([cloud, scene.frame.others.points]), np.concatenate([outside, more])
    reach = np.float32(gripper.max_width_m + gripper.finger_thickness_m)
    low, high = points.min(axis=0) - reach, points.max(axis=0) + reach
    with np.errstate(invalid="ignore"):
        near = outside & (cloud >= low).all(axis=-1) & (cloud <= high).all(axis=-1)
    found = cloud[near]
    found = found[upright.height(found) > 0.008]
    return found[voxel_downsample(found, _OBSTACLE_SPACING_M)]


def depth_gap(scene: Scene, points: Float) -> Float:
    """Return how far (N,) [m] points (N, 3) lie before (+, seen to be free) or behind (-, hidden) the seen surface.

    NaN where the point falls outside the image, behind the camera, or on a pixel without depth.
    """
    camera = scene.frame.camera
    gap = np.full(len(points), np.nan, np.float32)
    front = np.flatnonzero(points[:, 2] > 0.01)
    p = points[front]
    u = np.rint(p[:, 0] / p[:, 2] * camera.fx + camera.cx)
    v = np.rint(p[:, 1] / p[:, 2] * camera.fy + camera.cy)
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    z = scene.points[v[inside].astype(np.intp), u[inside].astype(np.intp), 2]
    gap[front[inside]] = z - p[inside, 2]
    return gap


def estimate_normals(points: Float, neighbours: int = 16) -> Float:
    """Estimate unit normals (N, 3) of points (N, 3) by local plane fits, turned towards the camera (the origin)."""
    k = min(neighbours, len(points))
    if k < 3:
        return -points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-9)
    local = points[KDTree(points).query(points, k=k)[1]].astype(np.float64)
    local -= local.mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", local, local))[1][:, :, 0].astype(np.float32)
    return np.where(np.sum(normals * points, axis=1, keepdims=True) > 0, -normals, normals)


def seen_surface(scene: Scene, mask: Mask, crop: Mask, max_points: int, voxel_m: float) -> Surface | None:
    """Sample what was seen of the object under `mask`, evenly and without lone points; None where there is too little.

    Args:
        scene: Gives the cloud and, where known, its normals, and what other cameras saw of the object.
        mask: The object (H, W).
        crop: Where grasps are wanted (H, W).
        max_points: The voxel grows until about this many points are left.
        voxel_m: Smallest voxel [m].
    """
    v, u = np.nonzero(mask & np.isfinite(scene.points[..., 2]))
    if len(u) < 8:
        return None
    points, wanted = scene.points[v, u], crop[v, u]
    normals = np.full_like(points, np.nan) if scene.normals is None else scene.normals[v, u]
    more = own_points(scene, mask)
    if len(more) and scene.frame.others is not None:
        others = scene.frame.others
        nearest = KDTree(points).query(others.points[more])[1]
        points = np.concatenate([points, others.points[more]])
        normals = np.concatenate([normals, others.normals[more]])
        wanted = np.concatenate([wanted, wanted[nearest]])
    keep = voxel_downsample(points, voxel_m)
    if len(keep) > max_points:
        keep = voxel_downsample(points, voxel_m * np.sqrt(len(keep) / max_points))
    p = points[keep]
    spacing = KDTree(p).query(p, k=min(5, len(p)))[0][:, -1]
    lone = spacing > 4 * max(float(np.median(spacing)), voxel_m)
    keep, p = keep[~lone], p[~lone]
    if len(p) < 8:
        return None
    normals = normals[keep]
    unknown = ~np.isfinite(normals).all(axis=1)
    if unknown.any():
        normals[unknown] = estimate_normals(p)[unknown]
    return Surface(p, normals, np.ones(len(p), bool), wanted[keep])


def half_turn(scene: Scene, seen: Surface, upright: Upright) -> Surface | None:
    """Complete a surface by half a turn about the vertical axis that explains the view best.

    Axes are scored by how much of the turned surface coincides with what is seen and how much of it falls into space
    that was seen to be free. Among about equally good axes their middle is taken.

    Returns:
        The turned points that the camera could not see; None when no axis explains the view.

    References:
        Bohg et al., Mind the gap - robotic grasping under incomplete observation, ICRA 2011.
    """
    side = np.cross(upright.up, upright.away)
    along, across = seen.points @ upright.away, seen.points @ side
    rows = np.linspace(0, len(seen) - 1, min(len(seen), 160)).astype(np.intp)
    front, back = np.quantile(along, [0.02, 0.98])
    left, right = np.quantile(across, [0.02, 0.98])
    reach = max(back - front, 0.5 * (right - left), 0.01)
    width = max(right - left, 0.01)
    centre = np.array([front + 0.55 * reach, (left + right) / 2])
    steps = np.array([0.5 * reach / 6, 0.24 * width / 3])
    least = np.inf
    for _ in range(2):
        grid = np.stack(np.meshgrid(np.arange(-6, 7), np.arange(-3, 4), indexing="ij"), -1).reshape(-1, 2)
        axes = centre + grid * steps
        turned = (
            2 * (seen.points[rows] @ upright.up)[None, :, None] * upright.up
            - seen.points[rows][None]
            + 2 * (axes[:, :1, None] * upright.away + axes[:, 1:, None] * side)
        ).astype(np.float32)
        gap = depth_gap(scene, turned.reshape(-1, 3)).reshape(len(axes), -1)
        free = np.clip((gap - 0.002) / 0.004, 0, 1)
        free[np.isnan(free)] = 0
        violation = free.mean(axis=1)
        match = (np.abs(gap) <= _FREE_TOLERANCE_M).mean(axis=1)
        score = match - 2 * violation - 0.01 * (axes[:, 0] - front) / width
        good = score > score.max() - 0.01
        centre = axes[good].mean(axis=0)
        least = violation[good].mean()
        steps = steps / 6
    if least > _MAX_VIOLATION:
        return None
    base = (centre[0] * upright.away + centre[1] * side).astype(np.float32)
    points = 2 * (seen.points @ upright.up)[:, None] * upright.up - seen.points + 2 * base
    normals = 2 * (seen.normals @ upright.up)[:, None] * upright.up - seen.normals
    hidden = ~(depth_gap(scene, points) > -_FREE_TOLERANCE_M) & (upright.height(points) > 0.002)
    return Surface(points[hidden], normals[hidden], np.zeros(int(hidden.sum()), bool), seen.wanted[hidden])


def contour_curtain(
    scene: Scene, mask: Mask, crop: Mask, seen: Surface, upright: Upright, max_points: int, *, extrapolate: bool
) -> Surface:
    """Infer surface from the occluding contour: the contour itself, and a curtain from it down to the support.

    At an occluding contour the surface turns away from the camera, so its normal is perpendicular to the ray and to
    the outline. Where the seen normals turn towards that one, the surface is round, and its widest line lies beyond
    the contour. Below, what cannot be seen is taken to be no narrower.

    Args:
        scene: Gives the depth image.
        mask: The object (H, W).
        crop: Where grasps are wanted (H, W).
        seen: The object's seen surface.
        upright: Up and away directions, and the support.
        max_points: At most so many contour points.
        extrapolate: Continue round surfaces beyond the contour; wanted where no symmetry tells more.
    """
    empty = Surface(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), np.zeros(0, bool), np.zeros(0, bool))
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if len(rows) == 0:
        return empty
    pad = 6
    y0, x0 = max(rows[0] - pad, 0), max(columns[0] - pad, 0)
    window = (slice(y0, rows[-1] + 1 + pad), slice(x0, columns[-1] + 1 + pad))
    m = mask[window]
    z = scene.points[window][..., 2]
    smooth = ndimage.gaussian_filter(m.astype(np.float32), 2.0, mode="nearest")
    once, twice = (ndimage.binary_erosion(m, iterations=k, border_value=1).astype(bool) for k in (1, 2))
    inner = once & ~twice & np.isfinite(z)
    v, u = np.nonzero(inner)
    if len(v) == 0:
        return empty
    gv = -(smooth[np.minimum(v + 1, m.shape[0] - 1), u] - smooth[np.maximum(v - 1, 0), u])
    gu = -(smooth[v, np.minimum(u + 1, m.shape[1] - 1)] - smooth[v, np.maximum(u - 1, 0)])
    length = np.hypot(gu, gv)
    outline = np.stack([gu, gv], -1) / np.maximum(length, 1e-6)[:, None]
    ov = np.clip(np.rint(v + 4 * outline[:, 1]).astype(np.intp), 0, m.shape[0] - 1)
    ou = np.clip(np.rint(u + 4 * outline[:, 0]).astype(np.intp), 0, m.shape[1] - 1)
    step_m = 0.004
    occluding = (length > 1e-3) & ~m[ov, ou] & ~(z[ov, ou] < z[v, u] + step_m)
    chosen = np.flatnonzero(occluding)
    if len(chosen) == 0:
        return empty
    chosen = chosen[np.linspace(0, len(chosen) - 1, min(len(chosen), max_points)).astype(np.intp)]
    v, u, outline = v[chosen], u[chosen], outline[chosen]
    p = scene.points[window][v, u]
    ray = p / np.linalg.norm(p, axis=1, keepdims=True)
    normal = np.concatenate([outline, np.zeros((len(p), 1))], axis=1).astype(np.float32)
    normal -= np.sum(normal * ray, axis=1, keepdims=True) * ray
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    pixel_m = p[:, 2] / np.float32(scene.frame.camera.fx)
    tree = KDTree(seen.points)
    near, inside = (np.sum(seen.normals[tree.query(p - d * normal)[1]] * normal, axis=1) for d in _TURN_OFFSETS_M)
    p = p + normal * (1.5 * pixel_m[:, None])
    wanted = crop[window][v, u]

    rise = normal @ upright.up
    level = normal - rise[:, None] * upright.up
    tilt = np.linalg.norm(level, axis=1)
    hangs = tilt > 0.4
    radius = _round_radius(near, inside, upright.height(p), rise)
    widest = p + (radius * (1 - tilt) / np.maximum(tilt, 1e-3))[:, None] * level - (radius * rise)[:, None] * upright.up
    beyond = (
        extrapolate
        & (radius > 0)
        & hangs
        & ~(depth_gap(scene, widest) > _FREE_TOLERANCE_M)
        & (upright.height(widest) > 0.003)
    )
    p = np.where(beyond[:, None], widest, p)
    normal = np.where(beyond[:, None], level / np.maximum(tilt, 1e-3)[:, None], normal).astype(np.float32)
    drops = np.arange(1, int(_CURTAIN_DEPTH_M / _CURTAIN_STEP_M) + 1, dtype=np.float32) * _CURTAIN_STEP_M
    below = (p[hangs][:, None] - drops[None, :, None] * upright.up).reshape(-1, 3)
    below_normal = np.repeat(level[hangs] / tilt[hangs, None], len(drops), axis=0)
    below_wanted = np.repeat(wanted[hangs], len(drops))
    good = ~(depth_gap(scene, below) > _FREE_TOLERANCE_M) & (upright.height(below) > 0.003)
    points = np.concatenate([p, below[good]])
    return Surface(
        points,
        np.concatenate([normal, below_normal[good]]),
        np.zeros(len(points), bool),
        np.concatenate([wanted, below_wanted[good]]),
    )


def _round_radius(near: Float, inside: Float, height: Float, rise: Float) -> Float:
    """Radius (N,) [m] of a round surface at contour points; 0 where it ends in an edge instead.

    Two bounds: how fast the normals turn on the way to the contour, and that a round body whose contour lies at this
    height touches the support.

    Args:
        near: Cosine (N,) between the contour's normal and the seen normal at the first of `_TURN_OFFSETS_M` from it.
        inside: The same at the second.
        height: Of the contour point (N,) above the support.
        rise: Upward part (N,) of the contour's normal.
    """
    turning = (_TURN_OFFSETS_M[1] - _TURN_OFFSETS_M[0]) / np.maximum(near - inside, 1e-3)
    resting = height / np.maximum(1 + rise, 0.2)
    radius = np.minimum(turning, resting)
    expected = 1 - 0.0035 / np.maximum(turning, 0.005) - 0.10
    return np.where((near > expected) & (radius < _MAX_ROUND_M) & (rise > 0.05), radius, 0).astype(np.float32)


def _not_free(scene: Scene, surface: Surface) -> Surface:
    """The inferred points that no other camera saw through."""
    if scene.frame.others is None:
        return surface
    keep = ~seen_free(scene.frame, surface.points, _FREE_TOLERANCE_M)
    return Surface(surface.points[keep], surface.normals[keep], surface.seen[keep], surface.wanted[keep])


def join(parts: list[Surface]) -> Surface:
    """Concatenate surfaces in the given order."""
    return Surface(
        np.concatenate([s.points for s in parts]),
        np.concatenate([s.normals for s in parts]),
        np.concatenate([s.seen for s in parts]),
        np.concatenate([s.wanted for s in parts]),
    )
