"""Solids: a surface together with the convex pieces that fill it, to be moved and joined as one.

Lengths are in millimetres here, as objects are measured by hand; everything that leaves the package is in metres.
A solid stands on z = 0 around the z axis unless its function says otherwise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from thinkgrasp.sim.catalogue import convex, shapes
from thinkgrasp.sim.catalogue.shapes import Surface
from thinkgrasp.sim.objects import CollisionPiece

Float = NDArray[np.float64]
MM = 1e-3


@dataclass(frozen=True, eq=False)
class Solid:
    """What is seen and what collides, in metres."""

    surface: Surface
    collisions: tuple[CollisionPiece, ...]

    def at(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Solid:
        """Shift [mm]."""
        return self._moved(np.eye(3), MM * np.array([x, y, z]))

    def turn(self, axis: str, degrees: float) -> Solid:
        """Turn about an axis "x", "y" or "z" through the origin."""
        return self._moved(Rotation.from_euler(axis, degrees, degrees=True).as_matrix(), np.zeros(3))

    def scaled(self, factor: float) -> Solid:
        """Grow about the origin."""
        vertices, faces = self.surface
        return Solid((vertices * factor, faces), tuple(convex.scaled(c, factor) for c in self.collisions))

    def ghost(self) -> Solid:
        """Return what is seen but does not collide: print, buttons, a stalk."""
        return Solid(self.surface, ())

    def __add__(self, other: Solid) -> Solid:
        return Solid(shapes.join(self.surface, other.surface), self.collisions + other.collisions)

    def _moved(self, rotation: Float, offset: Float) -> Solid:
        vertices, faces = self.surface
        return Solid(
            (vertices @ rotation.T + offset, faces),
            tuple(convex.moved(c, rotation, offset) for c in self.collisions),
        )


def leaf(length: float, width: float) -> Solid:
    """A flat leaf from the origin along x; seen, not touched."""
    outline = np.array([(0, 0), (0.35, -0.5), (0.7, -0.4), (1, 0), (0.7, 0.4), (0.35, 0.5)]) * [length, width]
    return prism(outline, 1.2).ghost()


def total(solids: Sequence[Solid]) -> Solid:
    """Join solids to one."""
    return Solid(shapes.join(*(s.surface for s in solids)), tuple(c for s in solids for c in s.collisions))


def ball(radius: float) -> Solid:
    """A sphere about the origin."""
    return egg(radius, radius, radius)


def egg(a: float, b: float, c: float, *, sides: int = 20) -> Solid:
    """An ellipsoid about the origin with these half axes."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, sides // 2 + 3)
    unit = shapes.revolve(np.column_stack([np.cos(angle).round(12), np.sin(angle)]), sides=sides)
    half = MM * np.array([a, b, c])
    round_ = a == b == c
    piece = CollisionPiece("sphere", (a * MM,)) if round_ else CollisionPiece("ellipsoid", tuple(half.tolist()))
    return Solid((unit[0] * half, unit[1]), (piece,))


def box(x: float, y: float, z: float, edge: float = 0.0) -> Solid:
    """A box about the origin in x and y, from z = 0 up; its edges are cut by `edge`."""
    half = MM * np.array([x, y, z]) / 2
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    cut = MM * edge * np.eye(3)
    points = np.concatenate([signs * (half - cut.sum(axis=0) + c) for c in cut]) if edge else signs * half
    points[:, 2] += half[2]
    surface = shapes.hull(points)
    if edge > 1:
        return Solid(surface, (convex.hull(points),))
    return Solid(surface, (CollisionPiece("box", tuple(half.tolist()), (0.0, 0.0, float(half[2]))),))


def prism(outline: ArrayLike, height: float) -> Solid:
    """A convex outline (K, 2) [mm] drawn up from z = 0."""
    flat = MM * np.asarray(outline, np.float64)
    points = np.concatenate([np.column_stack([flat, np.full(len(flat), z)]) for z in (0.0, MM * height)])
    return Solid(shapes.hull(points), (convex.hull(points),))


def loft(sections: ArrayLike, *, power: float = 2.0, sides: int = 24) -> Solid:
    """Superellipses (z, a, b) or (z, a, b, x) [mm] stacked along z; power 2 is round, 4 a rounded square."""
    rows = MM * np.asarray(sections, np.float64)
    if rows.shape[1] == 3:
        rows = np.column_stack([rows, np.zeros(len(rows))])
    return Solid(shapes.loft(rows, sides=sides, power=power), convex.stack(rows, power))


def turned(profile: ArrayLike, *, sides: int = 24) -> Solid:
    """A body turned on a lathe: (radius, z) [mm] from the bottom to the top."""
    r, z = np.asarray(profile, np.float64).T
    return loft(np.column_stack([z, r, r]), sides=sides)


def rod(radius: float, length: float, sides: int = 16) -> Solid:
    """A cylinder."""
    return turned([(radius, 0), (radius, length)], sides=sides)


def taper(r0: float, r1: float, length: float, *, sides: int = 16) -> Solid:
    """Two spheres and what lies between them: radius r0 about the origin, r1 about (0, 0, length).

    References:
        The common tangent of two circles touches both at the angle asin((r0 - r1) / length) above the equator.
    """
    lean = np.arcsin(np.clip((r0 - r1) / length, -1, 1))
    low, high = (np.linspace(*ends, sides // 4 + 3) for ends in ((-np.pi / 2, lean), (lean, np.pi / 2)))
    profile = np.concatenate(
        [
            np.column_stack([r0 * np.cos(low), r0 * np.sin(low)]),
            np.column_stack([r1 * np.cos(high), length + r1 * np.sin(high)]),
        ]
    )
    profile[[0, -1], 0] = 0.0
    middle = np.array([[z, r, r, 0.0] for r, z in profile[len(low) - 1 : len(low) + 1]]) * MM
    pieces = (
        CollisionPiece("sphere", (r0 * MM,)),
        *convex.stack(middle),
        CollisionPiece("sphere", (r1 * MM,), (0.0, 0.0, length * MM)),
    )
    return Solid(shapes.revolve(profile * MM, sides=sides), pieces)


def vessel(profile: ArrayLike, wall: float, floor: float | None = 4.0, *, sides: int = 24) -> Solid:
    """A hollow turned body, open at the top.

    Args:
        profile: (radius, z) [mm] of the outside from the bottom to the rim.
        wall: Thickness of the wall [mm].
        floor: Thickness of the floor [mm]; None = open below as well.
        sides: Corners around; the wall collides as half as many wedges.
    """
    outer = MM * np.asarray(profile, np.float64)
    inner = np.column_stack([outer[:, 0] - MM * wall, outer[:, 1]])
    if floor is None:
        outline = np.concatenate([outer, inner[::-1]])
        pieces: tuple[CollisionPiece, ...] = ()
    else:
        bottom, top = outer[0, 1], outer[0, 1] + MM * floor
        inner_bottom = float(np.interp(top, inner[:, 1], inner[:, 0]))
        above = inner[inner[:, 1] > top + 1e-9]
        outline = np.concatenate([[(0.0, bottom)], outer, above[::-1], [(inner_bottom, top), (0.0, top)]])
        pieces = convex.stack(
            np.array([[z, r, r, 0.0] for r, z in ((outer[0, 0], bottom), (np.interp(top, *outer.T[::-1]), top))])
        )
    kept = convex.straighten(outer)
    kept_inner = np.column_stack([kept[:, 0] - MM * wall, kept[:, 1]])
    return Solid(shapes.revolve(outline, sides=sides), pieces + convex.wedges(kept, kept_inner, sides // 2))


def tube(path: ArrayLike, radius: float | ArrayLike, *, sides: int = 8, closed: bool = False) -> Solid:
    """A round bar along a path (K, 3) [mm] with one radius or one per point."""
    points = MM * np.asarray(path, np.float64)
    radii = MM * np.broadcast_to(np.asarray(radius, np.float64), len(points))
    return Solid(shapes.sweep(points, radii, sides=sides, closed=closed), convex.chain(points, radii, closed=closed))


def arc(radius: float, start_deg: float, end_deg: float, count: int = 9, *, squash: float = 1.0) -> Float:
    """Return (count, 3) points of an arc in the x-y plane about the origin; y is multiplied by `squash`."""
    angle = np.radians(np.linspace(start_deg, end_deg, count))
    return np.column_stack([radius * np.cos(angle), radius * squash * np.sin(angle), np.zeros(count)])


def ring(radius: float, thickness: float, *, squash: float = 1.0, count: int = 16) -> Solid:
    """A closed round bar of radius `thickness` around z at z = 0; `squash` makes it oval."""
    path = arc(radius, 0, 360, count + 1, squash=squash)[:-1]
    return tube(path, thickness, closed=True)
