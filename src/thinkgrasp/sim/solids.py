"""Analytic solids that a ray can be cast against: exact distances and normals, vectorised over rays.

Each solid lives in its own frame; `T_object_solid` places it in the object it is a part of. Rays are given in the
solid's frame. A solid is a handful of surfaces (the sides, the caps, an inner wall), so that the nearest hit and its
outward normal follow from the surface that was hit.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import InputError

Float = NDArray[np.float64]
RGB = tuple[int, int, int]

EPS_M = 1e-7
"""Hits nearer than this along a ray of unit length count as the ray's own start."""


@dataclass(frozen=True)
class Paint:
    """Colour of a solid: plain, or with a band of a second colour around one of its axes (a label, a stripe)."""

    color: RGB
    accent: RGB | None = None
    band_m: tuple[float, float] = (0.0, 0.0)
    """Where the accent lies along `axis`, in the solid's frame [m]."""
    axis: int = 2

    def at(self, points: Float) -> Float:
        """Return the albedo (N, 3) in 0..1 at surface points (N, 3) of the solid's frame."""
        albedo = np.broadcast_to(np.array(self.color) / 255.0, points.shape)
        if self.accent is None:
            return albedo
        inside = (points[:, self.axis] >= self.band_m[0]) & (points[:, self.axis] <= self.band_m[1])
        return np.where(inside[:, None], np.array(self.accent) / 255.0, albedo)


class Solid(Protocol):
    """What the renderer needs of a shape."""

    @property
    def paint(self) -> Paint: ...

    @property
    def T_object_solid(self) -> Float:  # noqa: N802
        """(4, 4) solid to object."""
        ...

    @property
    def aabb(self) -> Float:
        """(2, 3) lowest and highest corner in the solid's frame [m]."""
        ...

    def distances(self, origin: Float, direction: Float) -> Float:
        """Return (S, N) ray parameters t > 0 of the nearest hit per surface; inf = none.

        Args:
            origin: (3,) or (N, 3) [m].
            direction: (N, 3), any length; a hit is at origin + t * direction.
        """
        ...

    def normals(self, points: Float, surface: NDArray[np.intp]) -> Float:
        """Return (N, 3) unit outward normals at hits on these surfaces (N,)."""
        ...


def _positive(**lengths: float) -> None:
    for name, value in lengths.items():
        if not (np.isfinite(value) and value > 0):
            raise InputError(f"{name} must be positive [m], got {value}")


def _first(t: Float, valid: NDArray[np.bool_]) -> Float:
    return np.where(valid & (t > EPS_M), t, np.inf)


def _roots(a: Float, b: Float, c: Float) -> tuple[Float, Float]:
    """Return the lower and upper root of a t^2 + 2 b t + c = 0; NaN where there is none."""
    with np.errstate(invalid="ignore", divide="ignore"):
        root = np.sqrt(b * b - a * c)
        t0, t1 = (-b - root) / a, (-b + root) / a
    return np.fmin(t0, t1), np.fmax(t0, t1)


def _disc(origin: Float, direction: Float, z: float, inner: float, outer: float) -> Float:
    """Distance to the ring inner..outer in the plane z."""
    with np.errstate(invalid="ignore", divide="ignore"):
        t = (z - origin[..., 2]) / direction[:, 2]
        x = origin[..., 0] + t * direction[:, 0]
        y = origin[..., 1] + t * direction[:, 1]
        r2 = x * x + y * y
        return _first(t, (r2 <= outer * outer) & (r2 >= inner * inner))


def _cone_side(origin: Float, direction: Float, r_mid: float, slope: float, z0: float, z1: float) -> Float:
    """Distance to the side x^2 + y^2 = (r_mid + slope z)^2 between the planes z0 and z1."""
    ox, oy, oz = origin[..., 0], origin[..., 1], origin[..., 2]
    dx, dy, dz = direction.T
    r = r_mid + slope * oz
    roots = _roots(
        dx * dx + dy * dy - slope * slope * dz * dz, ox * dx + oy * dy - slope * dz * r, ox * ox + oy * oy - r * r
    )
    with np.errstate(invalid="ignore"):
        hits = [_first(t, (oz + t * dz >= z0) & (oz + t * dz <= z1)) for t in roots]
    return np.minimum(*hits)


def _sphere(origin: Float, direction: Float, radius: float, z0: float = -np.inf, z1: float = np.inf) -> Float:
    """Distance to the sphere around the origin between the planes z0 and z1."""
    a = np.einsum("ij,ij->i", direction, direction)
    b = np.einsum("...j,...j->...", origin, direction)
    roots = _roots(a, b, np.einsum("...j,...j->...", origin, origin) - radius * radius)
    oz, dz = origin[..., 2], direction[:, 2]
    with np.errstate(invalid="ignore"):
        hits = [_first(t, (oz + t * dz >= z0) & (oz + t * dz <= z1)) for t in roots]
    return np.minimum(*hits)


def _unit(v: Float) -> Float:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)


@dataclass(frozen=True, eq=False)
class Box:
    """A cuboid centred at its frame's origin."""

    size_m: tuple[float, float, float]
    paint: Paint
    T_object_solid: Float = field(default_factory=lambda: np.eye(4))

    def __post_init__(self) -> None:
        _positive(**{f"size_m[{i}]": s for i, s in enumerate(self.size_m)})

    @property
    def aabb(self) -> Float:
        half = np.array(self.size_m) / 2
        return np.array([-half, half])

    def distances(self, origin: Float, direction: Float) -> Float:
        half = np.array(self.size_m) / 2
        with np.errstate(invalid="ignore", divide="ignore"):
            t = np.sort(np.array([(-half - origin) / direction, (half - origin) / direction]), axis=0)
        enter, leave = np.nanmax(t[0], axis=1), np.nanmin(t[1], axis=1)
        return _first(np.where(enter > EPS_M, enter, leave), enter <= leave)[None]

    def normals(self, points: Float, surface: NDArray[np.intp]) -> Float:
        ratio = points / (np.array(self.size_m) / 2)
        side = np.argmax(np.abs(ratio), axis=1)
        normals = np.zeros_like(points)
        rows = np.arange(len(points))
        normals[rows, side] = np.sign(ratio[rows, side])
        return normals


@dataclass(frozen=True, eq=False)
class Cylinder:
    """A capped cylinder, or a frustum when `top_radius_m` is given; axis z, centred at its frame's origin."""

    radius_m: float
    height_m: float
    paint: Paint
    T_object_solid: Float = field(default_factory=lambda: np.eye(4))
    top_radius_m: float | None = None

    def __post_init__(self) -> None:
        _positive(radius_m=self.radius_m, height_m=self.height_m, top_radius_m=self._top)

    @property
    def _top(self) -> float:
        return self.radius_m if self.top_radius_m is None else self.top_radius_m

    @property
    def _slope(self) -> float:
        return (self._top - self.radius_m) / self.height_m

    @property
    def aabb(self) -> Float:
        r = max(self.radius_m, self._top)
        return np.array([[-r, -r, -self.height_m / 2], [r, r, self.height_m / 2]])

    def distances(self, origin: Float, direction: Float) -> Float:
        h = self.height_m / 2
        return np.stack(
            [
                _cone_side(origin, direction, (self.radius_m + self._top) / 2, self._slope, -h, h),
                _disc(origin, direction, -h, 0.0, self.radius_m),
                _disc(origin, direction, h, 0.0, self._top),
            ]
        )

    def normals(self, points: Float, surface: NDArray[np.intp]) -> Float:
        side = points.copy()
        side[:, 2] = -self._slope * np.linalg.norm(points[:, :2], axis=1)
        caps = np.array([[0.0, 0, 0], [0, 0, -1], [0, 0, 1]])[surface]
        return np.where((surface == 0)[:, None], _unit(side), caps)


@dataclass(frozen=True, eq=False)
class Ellipsoid:
    """An ellipsoid around its frame's origin; a sphere when the three semi-axes are equal."""

    semi_axes_m: tuple[float, float, float]
    paint: Paint
    T_object_solid: Float = field(default_factory=lambda: np.eye(4))

    def __post_init__(self) -> None:
        _positive(**{f"semi_axes_m[{i}]": s for i, s in enumerate(self.semi_axes_m)})

    @property
    def aabb(self) -> Float:
        half = np.array(self.semi_axes_m)
        return np.array([-half, half])

    def distances(self, origin: Float, direction: Float) -> Float:
        scale = np.array(self.semi_axes_m)
        return _sphere(origin / scale, direction / scale, 1.0)[None]

    def normals(self, points: Float, surface: NDArray[np.intp]) -> Float:
        return _unit(points / np.square(self.semi_axes_m))


@dataclass(frozen=True, eq=False)
class Cup:
    """An open cup: a cylinder or frustum with a wall and a floor of `wall_m`, axis z, its outer bottom at z = 0."""

    radius_m: float
    height_m: float
    paint: Paint
    T_object_solid: Float = field(default_factory=lambda: np.eye(4))
    top_radius_m: float | None = None
    wall_m: float = 0.004

    def __post_init__(self) -> None:
        _positive(radius_m=self.radius_m, height_m=self.height_m, wall_m=self.wall_m, top_radius_m=self._top)
        if self.wall_m >= min(self.radius_m, self._top, self.height_m):
            raise InputError(f"a wall of {self.wall_m} m leaves no room inside a cup of radius {self.radius_m} m")

    @property
    def _top(self) -> float:
        return self.radius_m if self.top_radius_m is None else self.top_radius_m

    @property
    def _slope(self) -> float:
        return (self._top - self.radius_m) / self.height_m

    @property
    def aabb(self) -> Float:
        r = max(self.radius_m, self._top)
        return np.array([[-r, -r, 0.0], [r, r, self.height_m]])

    def distances(self, origin: Float, direction: Float) -> Float:
        r, top, h, w, slope = self.radius_m, self._top, self.height_m, self.wall_m, self._slope
        return np.stack(
            [
                _cone_side(origin, direction, r, slope, 0.0, h),
                _cone_side(origin, direction, r - w, slope, w, h),
                _disc(origin, direction, h, top - w, top),
                _disc(origin, direction, w, 0.0, r - w + slope * w),
                _disc(origin, direction, 0.0, 0.0, r),
            ]
        )

    def normals(self, points: Float, surface: NDArray[np.intp]) -> Float:
        side = points.copy()
        side[:, 2] = -self._slope * np.linalg.norm(points[:, :2], axis=1)
        side = _unit(side) * np.where(surface == 1, -1.0, 1.0)[:, None]
        flat = np.array([[0.0, 0, 0], [0, 0, 0], [0, 0, 1], [0, 0, 1], [0, 0, -1]])[surface]
        return np.where((surface <= 1)[:, None], side, flat)


@dataclass(frozen=True, eq=False)
class Bowl:
    """The lower part of a spherical shell, open at the top; its outer lowest point at z = 0, its rim at `height_m`."""

    radius_m: float
    height_m: float
    paint: Paint
    T_object_solid: Float = field(default_factory=lambda: np.eye(4))
    wall_m: float = 0.005

    def __post_init__(self) -> None:
        _positive(radius_m=self.radius_m, height_m=self.height_m, wall_m=self.wall_m)
        if not self.wall_m < self.height_m < 2 * self.radius_m - self.wall_m:
            raise InputError(f"bowl height must lie between its wall and its diameter, got {self.height_m} m")

    def _rim(self, radius: float) -> float:
        return float(np.sqrt(radius**2 - (self.height_m - self.radius_m) ** 2))

    @property
    def aabb(self) -> Float:
        r = self._rim(self.radius_m) if self.height_m < self.radius_m else self.radius_m
        return np.array([[-r, -r, 0.0], [r, r, self.height_m]])

    def distances(self, origin: Float, direction: Float) -> Float:
        R, inner = self.radius_m, self.radius_m - self.wall_m
        o = origin - np.array([0.0, 0, R])
        cut = self.height_m - R
        return np.stack(
            [
                _sphere(o, direction, R, z1=cut),
                _sphere(o, direction, inner, z1=cut),
                _disc(o, direction, cut, self._rim(inner), self._rim(R)),
            ]
        )

    def normals(self, points: Float, surface: NDArray[np.intp]) -> Float:
        radial = _unit(points - np.array([0.0, 0, self.radius_m])) * np.where(surface == 1, -1.0, 1.0)[:, None]
        return np.where((surface == 2)[:, None], np.array([0.0, 0, 1]), radial)


@dataclass(frozen=True, eq=False)
class Tube:
    """A chain of capsules along points (K, 3), K >= 2, with a radius at each joint: bananas, handles, stalks."""

    path_m: Float
    radii_m: tuple[float, ...]
    paint: Paint
    T_object_solid: Float = field(default_factory=lambda: np.eye(4))

    def __post_init__(self) -> None:
        if self.path_m.ndim != 2 or self.path_m.shape[1] != 3 or len(self.path_m) < 2:
            raise InputError(f"a tube's path must be (K, 3) with K >= 2, got {self.path_m.shape}")
        if len(self.radii_m) != len(self.path_m):
            raise InputError(f"a tube of {len(self.path_m)} points needs as many radii, got {len(self.radii_m)}")
        _positive(**{f"radii_m[{i}]": r for i, r in enumerate(self.radii_m)})

    @property
    def aabb(self) -> Float:
        r = np.array(self.radii_m)[:, None]
        return np.array([(self.path_m - r).min(axis=0), (self.path_m + r).max(axis=0)])

    def distances(self, origin: Float, direction: Float) -> Float:
        a, b = self.path_m[:-1], self.path_m[1:]
        radii = [(r0 + r1) / 2 for r0, r1 in zip(self.radii_m, self.radii_m[1:], strict=False)]
        sides = [_capsule_side(origin, direction, p, q, r) for p, q, r in zip(a, b, radii, strict=True)]
        joints = [_sphere(origin - p, direction, r) for p, r in zip(self.path_m, self.radii_m, strict=True)]
        return np.stack(sides + joints)

    def normals(self, points: Float, surface: NDArray[np.intp]) -> Float:
        k = len(self.path_m) - 1
        segment = np.minimum(surface, k - 1)
        a, axis = self.path_m[segment], (self.path_m[1:] - self.path_m[:-1])[segment]
        along = np.einsum("ij,ij->i", points - a, axis) / np.einsum("ij,ij->i", axis, axis)
        center = np.where((surface < k)[:, None], a + along[:, None] * axis, self.path_m[np.maximum(surface - k, 0)])
        return _unit(points - center)


def _capsule_side(origin: Float, direction: Float, a: Float, b: Float, radius: float) -> Float:
    """Distance to the cylinder of this radius between a and b, without caps."""
    length = float(np.linalg.norm(b - a))
    axis = (b - a) / length
    o = origin - a
    o_along, d_along = o @ axis, direction @ axis
    o_across, d_across = o - np.multiply.outer(o_along, axis), direction - np.multiply.outer(d_along, axis)
    roots = _roots(
        np.einsum("ij,ij->i", d_across, d_across),
        np.einsum("...j,...j->...", o_across, d_across),
        np.einsum("...j,...j->...", o_across, o_across) - radius * radius,
    )
    with np.errstate(invalid="ignore"):
        hits = [_first(t, (o_along + t * d_along >= 0) & (o_along + t * d_along <= length)) for t in roots]
    return np.minimum(*hits)
