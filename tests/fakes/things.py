"""Simple objects for the simulator: a box, a ball and a mug-like pair of parts."""

from __future__ import annotations

import numpy as np
import trimesh

from thinkgrasp.sim.objects import CollisionPiece, SimObject, Texture, VisualPiece

RGB = tuple[float, float, float]


def piece(mesh: trimesh.Trimesh, color: RGB, *, part: str = "body", texture: Texture | None = None) -> VisualPiece:
    """A mesh as a visual piece."""
    return VisualPiece(part, mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32), color, texture, 0.2)


def thing(name: str, visuals: tuple[VisualPiece, ...], *collisions: CollisionPiece) -> SimObject:
    """An object of 200 g."""
    return SimObject(name, "thing", (), (), 0.2, 0.6, visuals, collisions)


def box(size: tuple[float, float, float], color: RGB, texture: Texture | None = None) -> SimObject:
    """A cuboid, its origin in the middle."""
    half = tuple(s / 2 for s in size)
    return thing("box", (piece(trimesh.creation.box(size), color, texture=texture),), CollisionPiece("box", half))


def ball(radius: float, color: RGB) -> SimObject:
    """A sphere of 480 triangles."""
    mesh = trimesh.creation.uv_sphere(radius=radius, count=[16, 16])
    return thing("ball", (piece(mesh, color),), CollisionPiece("sphere", (radius,)))


def hammer(head: RGB, handle: RGB) -> SimObject:
    """A box with a bar at its +x side: two parts."""
    bar = trimesh.creation.box((0.10, 0.02, 0.02), trimesh.transformations.translation_matrix((0.07, 0, 0)))
    visuals = (piece(trimesh.creation.box((0.04, 0.08, 0.04)), head, part="head"), piece(bar, handle, part="handle"))
    return thing(
        "hammer",
        visuals,
        CollisionPiece("box", (0.02, 0.04, 0.02)),
        CollisionPiece("box", (0.05, 0.01, 0.01), (0.07, 0.0, 0.0)),
    )
