"""The analytic quality of any grasp on a known surface, by one rule for the candidates of every generator.

Where do the fingers meet the surface when they close, and how much friction does that pair of contacts need? The
surface is a mesh, such as an object's true model, or a cloud with normals, such as what one view tells.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.contacts import EVALUATED_FRICTIONS, FRICTIONS, smallest_friction
from thinkgrasp.errors import InputError
from thinkgrasp.gripper import Gripper
from thinkgrasp.types import Grasps

Float = NDArray[np.float64]

_MAX_PAIRS = 200_000


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """A surface of triangles, closed or not, in the grasps' frame.

    Raises:
        InputError: The arrays have another shape, or a face names a vertex that is not there.
    """

    vertices: NDArray[np.floating]
    """(V, 3) [m]."""
    faces: NDArray[np.integer]
    """(F, 3) indices of vertices; their order does not matter."""

    def __post_init__(self) -> None:
        for name, array in (("vertices", self.vertices), ("faces", self.faces)):
            if array.ndim != 2 or array.shape[1] != 3:
                raise InputError(f"a mesh's {name} must be (n, 3), got {array.shape}")
        if self.faces.size and not (self.faces.min() >= 0 and self.faces.max() < len(self.vertices)):
            raise InputError(
                f"a mesh of {len(self.vertices)} vertices has faces {self.faces.min()}..{self.faces.max()}"
            )


@dataclass(frozen=True, eq=False)
class OrientedCloud:
    """Points of a surface with its normals, in the grasps' frame.

    Raises:
        InputError: The arrays have another shape, or the radius is not positive.
    """

    points: NDArray[np.floating]
    """(M, 3) [m]; what is not finite is left out."""
    normals: NDArray[np.floating]
    """(M, 3), of either sign."""
    radius_m: float = 0.005
    """Half breadth of what a finger touches; about the points' spacing or more."""

    def __post_init__(self) -> None:
        if self.points.ndim != 2 or self.points.shape[1] != 3 or self.normals.shape != self.points.shape:
            raise InputError(
                f"a cloud must be points and normals (n, 3), got {self.points.shape}, {self.normals.shape}"
            )
        if not self.radius_m > 0:
            raise InputError(f"a cloud's radius_m must be positive, got {self.radius_m}")


Surface = TriangleMesh | OrientedCloud


@dataclass(frozen=True, eq=False)
class Contacts:
    """Where two closing fingers first meet a surface; NaN where they meet none."""

    points: Float
    """(N, 2, 3) [m], first on the side of -x of the grasp frame."""
    normals: Float
    """(N, 2, 3)."""


def find_contacts(grasps: Grasps, surface: Surface, *, behind_tip_m: float = 0.0) -> Contacts:
    """Close two fingers along a line and return what each meets first, on its way to the middle.

    Args:
        grasps: The line runs along their closing direction, half their width to each side.
        surface: In the grasps' frame.
        behind_tip_m: How far the line lies behind the TCP, against the approach.

    References:
        Fang et al., GraspNet-1Billion, CVPR 2020, and its evaluation in graspnetAPI, which walks through a signed
        distance field; this meets the surface itself.
    """
    points = np.full((len(grasps), 2, 3), np.nan)
    normals = np.full((len(grasps), 2, 3), np.nan)
    meet = _meet_triangles if isinstance(surface, TriangleMesh) else _meet_points
    R, half = grasps.rotations.astype(np.float64), grasps.widths.astype(np.float64) / 2
    origin = grasps.positions.astype(np.float64) - behind_tip_m * R[:, :, 2]
    for side, sign in enumerate((-1.0, 1.0)):
        for rows, x, normal in meet(surface, R, origin, half, sign):  # type: ignore[arg-type]
            points[rows, side] = origin[rows] + x[:, None] * R[rows, :, 0]
            normals[rows, side] = normal
    return Contacts(points, normals)


def grasp_friction(
    grasps: Grasps,
    surface: Surface,
    *,
    frictions: tuple[float, ...] = EVALUATED_FRICTIONS,
    behind_tip_m: tuple[float, ...] = (0.0,),
) -> Float:
    """Return the smallest friction coefficient at which each grasp closes on a surface: lower is better.

    Args:
        grasps: In the surface's frame.
        surface: What they close on.
        frictions: Coefficients tried, largest first.
        behind_tip_m: A pad touches along its length; the best of lines this far behind the TCP counts. The evaluation
            of GraspNet-1Billion looks at the TCP alone.

    Returns:
        (N,) coefficient; inf where a finger meets nothing or the pair is not closed even at the largest (graspnetAPI
        writes -1 there).

    References:
        Nguyen, Constructing force-closure grasps, IJRR 1988. Fang et al., GraspNet-1Billion, CVPR 2020, section 3.
    """
    best = np.full(len(grasps), np.inf)
    for behind in behind_tip_m:
        contacts = find_contacts(grasps, surface, behind_tip_m=behind)
        friction = smallest_friction(
            contacts.points[:, 0],
            contacts.points[:, 1],
            contacts.normals[:, 0],
            contacts.normals[:, 1],
            frictions=frictions,
            oriented=False,
        )
        best = np.minimum(best, friction)
    return best


def pad_friction(
    grasps: Grasps, cloud: OrientedCloud, gripper: Gripper, *, frictions: tuple[float, ...] = FRICTIONS
) -> Float:
    """Return the smallest friction coefficient at which a gripper's pads close on a cloud, (N,); inf as above.

    Of each pad, as broad as the fingers and as long as the gripper says, what it meets first counts.

    Args:
        grasps: In the cloud's frame.
        cloud: The object's surface.
        gripper: Gives the pads.
        frictions: Coefficients tried, largest first.
    """
    pad = gripper.finger_breadth_m / 2, gripper.pad_length_m
    points, normals = (np.full((len(grasps), 2, 3), np.nan) for _ in range(2))
    R, half = grasps.rotations.astype(np.float64), grasps.widths.astype(np.float64) / 2
    origin = grasps.positions.astype(np.float64)
    for side, sign in enumerate((-1.0, 1.0)):
        for rows, x, normal in _meet_points(cloud, R, origin, half, sign, pad):
            points[rows, side] = origin[rows] + x[:, None] * R[rows, :, 0]
            normals[rows, side] = normal
    return smallest_friction(
        points[:, 0], points[:, 1], normals[:, 0], normals[:, 1], frictions=frictions, oriented=False
    )


_Met = tuple[slice | NDArray[np.intp], Float, Float]
"""Rows that meet something, where on the closing line [m], and the normal there."""


def _meet_triangles(mesh: TriangleMesh, R: Float, origin: Float, half: Float, sign: float) -> Iterator[_Met]:
    corners = np.asarray(mesh.vertices, np.float64)[mesh.faces]
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    chunk = max(1, _MAX_PAIRS // max(len(corners), 1))
    for start in range(0, len(R) if len(corners) else 0, chunk):
        rows = np.arange(start, min(start + chunk, len(R)))
        local = (
            np.einsum("fcj,nji->nfci", corners, R[rows]) - np.einsum("nj,nji->ni", origin[rows], R[rows])[:, None, None]
        )
        y, z = local[..., 1], local[..., 2]
        # Twice the signed areas of the triangles between the line, a point in this view, and each edge.
        area = np.stack(
            [y[..., a] * z[..., b] - y[..., b] * z[..., a] for a, b in ((1, 2), (2, 0), (0, 1))], axis=-1
        )  # fmt: skip
        whole = area.sum(axis=-1)
        crossed = ((area >= 0).all(axis=-1) | (area <= 0).all(axis=-1)) & (np.abs(whole) > 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            x = sign * (local[..., 0] * area).sum(axis=-1) / whole
        x = np.where(crossed & (x >= 0) & (x <= half[rows, None]), x, -np.inf)
        face = x.argmax(axis=1)
        first = x[np.arange(len(rows)), face]
        met = np.isfinite(first)
        yield rows[met], sign * first[met], face_normals[face[met]]


def _meet_points(
    cloud: OrientedCloud,
    R: Float,
    origin: Float,
    half: Float,
    sign: float,
    pad: tuple[float, float] | None = None,
) -> Iterator[_Met]:
    """What lies within the cloud's radius of the line is met; or within a pad's half breadth and length."""
    good = np.isfinite(cloud.points).all(axis=1) & np.isfinite(cloud.normals).all(axis=1)
    points, normals = cloud.points[good].astype(np.float64), cloud.normals[good].astype(np.float64)
    chunk = max(1, _MAX_PAIRS // max(len(points), 1))
    for start in range(0, len(R) if len(points) else 0, chunk):
        rows = np.arange(start, min(start + chunk, len(R)))
        local = np.einsum("mj,nji->nmi", points, R[rows]) - np.einsum("nj,nji->ni", origin[rows], R[rows])[:, None]
        x = sign * local[..., 0]
        y, z = local[..., 1], local[..., 2]
        if pad is None:
            near = y**2 + z**2 <= cloud.radius_m**2
        else:
            near = (np.abs(y) <= pad[0]) & (z <= 0) & (z >= -pad[1])
        near &= (x >= 0) & (x <= half[rows, None])
        first = np.where(near, x, -np.inf).max(axis=1)
        met = np.isfinite(first)
        touched = near[met] & (x[met] >= first[met, None] - cloud.radius_m)
        # Of the touched points' normals, those of the other side of a thin wall are turned round before the mean.
        outward = normals * np.where((R[rows[met], :, 0] @ normals.T) * sign < 0, -1.0, 1.0)[..., None]
        yield rows[met], sign * first[met], (outward * touched[..., None]).sum(axis=1)
