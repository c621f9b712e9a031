"""The world as simple meshes with poses, for viewers that draw it themselves."""

# MuJoCo's bindings carry no types.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import trimesh
from numpy.typing import NDArray

from thinkgrasp.geometry import quat_wxyz
from thinkgrasp.sim.world import COLLISION_GROUP, World


@dataclass(frozen=True, eq=False)
class ShownMesh:
    """One visible geom; its pose is that of the geom, or of the body where the vertices are in the body's frame."""

    name: str
    geom: int
    of_body: bool
    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    color: tuple[int, int, int]


def shown_meshes(world: World) -> list[ShownMesh]:
    """Return everything that a camera could see, the floor left out."""
    meshes: list[ShownMesh] = []
    model = world.model
    for geom in range(model.ngeom):
        if model.geom_group[geom] >= COLLISION_GROUP:
            continue
        if geom in world.visuals:
            piece = world.visuals[geom]
            shape, of_body, rgb = (piece.vertices, piece.faces), True, piece.color
        else:
            made = _primitive(int(model.geom_type[geom]), model.geom_size[geom])
            if made is None:
                continue
            shape, of_body, rgb = made, False, tuple(model.geom_rgba[geom][:3])
        red, green, blue = (round(255 * float(c)) for c in rgb)
        meshes.append(ShownMesh(f"geom_{geom}", geom, of_body, *shape, (red, green, blue)))
    return meshes


def mesh_poses(world: World, meshes: list[ShownMesh]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return unit quaternions (N, 4) wxyz and positions (N, 3) [m] of meshes in the world."""
    data, body = world.data, world.model.geom_bodyid
    R = [data.xmat[body[m.geom]] if m.of_body else data.geom_xmat[m.geom] for m in meshes]
    p = [data.xpos[body[m.geom]] if m.of_body else data.geom_xpos[m.geom] for m in meshes]
    return np.array([quat_wxyz(r.reshape(3, 3)) for r in R]), np.array(p)


def _primitive(kind: int, size: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.int32]] | None:
    match kind:
        case mujoco.mjtGeom.mjGEOM_BOX:
            mesh = trimesh.creation.box(2 * size)
        case mujoco.mjtGeom.mjGEOM_CAPSULE:
            mesh = trimesh.creation.capsule(2 * size[1], size[0], count=[12, 12])
            mesh.apply_translation(-mesh.bounds.mean(axis=0))
        case _:
            return None
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32)
