"""A person's own objects: a folder per object with `model.urdf` and, if wanted, `object.toml`.

    objects/
      banana/
        model.urdf      links, visual and collision shapes, mass; mesh paths relative to this folder
        object.toml     optional: name, category, colors, uses

Links that are joined by fixed joints become one body; other joints are refused. The URDF's axes are kept, and the
object frame's origin is the middle of what is seen, since published frames often lie outside the thing. Mass is
spread over the collision shapes: the inertia tensor of the file is not used.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thinkgrasp.errors import InputError
from thinkgrasp.geometry import make_transform, quat_wxyz
from thinkgrasp.perception.color import lab_from_rgb, name_colors
from thinkgrasp.sim.description import Description, read_description
from thinkgrasp.sim.markup import Node, parse_markup
from thinkgrasp.sim.meshes import Mesh, convex_parts, read_mesh, transformed
from thinkgrasp.sim.objects import CollisionPiece, SimObject, VisualPiece

Float = NDArray[np.float64]

MODEL = "model.urdf"
DESCRIPTION = "object.toml"
DEFAULT_FRICTION = 0.6
DEFAULT_RGB = (0.7, 0.7, 0.7)
"""What has no material is light grey."""
LONGEST_SIDE_M = (0.01, 0.6)
"""What a table top and a hand of 85 mm can make sense of."""
RIM_SEGMENTS = 48


def load_objects(folder: Path | str) -> tuple[SimObject, ...]:
    """Load every object of a folder, one sub-folder each, in the order of their folder names.

    Args:
        folder: Holds one folder per object; hidden folders and plain files are skipped.

    Raises:
        InputError: The folder holds no object folder, two objects have one name, or `load_object` refuses one.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; it must hold one folder per object, each with {MODEL}")
    places = sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith("."))
    if not places:
        hint = f"; it holds {MODEL} itself: name the folder above it" if (folder / MODEL).is_file() else ""
        raise InputError(f"{folder}: holds no object folders{hint}. Each object needs a folder with {MODEL}")
    objects = tuple(load_object(p) for p in places)
    for i, obj in enumerate(objects):
        first = next(j for j, o in enumerate(objects) if o.name == obj.name)
        if first < i:
            raise InputError(f"{places[i]}: named {obj.name!r}, as is {places[first]}; names must differ")
    return objects


def load_object(folder: Path | str) -> SimObject:
    """Load one object.

    A collision mesh that is not convex is decomposed by CoACD where that is installed; else its hollows are filled
    and a UserWarning says so.

    Args:
        folder: Holds model.urdf, the meshes that it names, and optionally object.toml.

    Raises:
        InputError: A file is missing, cannot be read or says something impossible; the message starts with
            "file:line:" where there is a line to name.
    """
    folder = Path(folder)
    path = folder / MODEL
    if not path.is_file():
        raise InputError(f"{path}: no such file; an object's folder must hold {MODEL}")
    robot = parse_markup(path)
    if robot.tag != "robot":
        raise robot.error(f"a URDF starts with <robot>, found <{robot.tag}>")
    poses = _link_poses(robot)
    materials = {m.text("name"): m for m in robot.all("material") if m.one("color") is not None}
    visuals: list[VisualPiece] = []
    collisions: list[CollisionPiece] = []
    for link, T_base_link in poses:
        lone = len(poses) == 1
        for node in link.all("visual"):
            visuals += _visuals(node, T_base_link, folder, materials, "" if lone else f"{link.text('name')}/")
        for node in link.all("collision"):
            collisions += _collisions(node, T_base_link, folder)
    for what, found in (("visual", visuals), ("collision", collisions)):
        if not found:
            raise robot.error(f"no link has a <{what}>; add a mesh, box, cylinder or sphere")
    center = _center_of_fitting_size(visuals, robot)
    known = read_description(folder / DESCRIPTION, folder.name)
    return _made(robot, [link for link, _ in poses], known, visuals, collisions, center, folder)


def _made(
    robot: Node,
    links: list[Node],
    known: Description,
    visuals: list[VisualPiece],
    collisions: list[CollisionPiece],
    center: Float,
    folder: Path,
) -> SimObject:
    return SimObject(
        name=known.name,
        category=known.category,
        colors=known.colors or _colors(visuals),
        uses=known.uses,
        mass_kg=_mass(robot, links),
        friction=_friction(links),
        visuals=tuple(replace(v, vertices=(v.vertices - center).astype(np.float32)) for v in visuals),
        collisions=tuple(_moved(c, -center) for c in collisions),
        source=str(folder),
    )


def _moved(piece: CollisionPiece, by: Float) -> CollisionPiece:
    if piece.points_m is not None:
        return replace(piece, points_m=piece.points_m + by)
    x, y, z = (float(v) for v in np.array(piece.position_m) + by)
    return replace(piece, position_m=(x, y, z))


def _link_poses(robot: Node) -> list[tuple[Node, Float]]:
    """Return every link with its pose in the base link (4, 4), the base first."""
    links = {link.text("name"): link for link in robot.all("link")}
    if not links:
        raise robot.error("a URDF needs at least one <link>")
    parent_of: dict[str, tuple[str, Float]] = {}
    for joint in robot.all("joint"):
        if joint.text("type") != "fixed":
            raise joint.error(
                f"joint {joint.text('name')!r} is {joint.text('type')!r}; an object's joints must be 'fixed'"
            )
        parent, child = (joint.need(end).text("link") for end in ("parent", "child"))
        for name in (parent, child):
            if name not in links:
                raise joint.error(f"no link is named {name!r}; links are {', '.join(links)}")
        if child in parent_of:
            raise joint.error(f"link {child!r} has two parents")
        parent_of[child] = (parent, _origin(joint))
    bases = [name for name in links if name not in parent_of]
    if len(bases) != 1:
        raise robot.error(
            f"links must hang together by fixed joints under one base, but the bases are {bases or 'none'}"
        )
    poses = {bases[0]: np.eye(4)}
    while len(poses) < len(links):
        ready = [c for c, (p, _) in parent_of.items() if p in poses and c not in poses]
        if not ready:
            raise robot.error(f"joints run in a circle among {', '.join(sorted(links.keys() - poses.keys()))}")
        poses |= {c: poses[parent_of[c][0]] @ parent_of[c][1] for c in ready}
    return [(links[name], T) for name, T in poses.items()]


def _origin(node: Node) -> Float:
    """The <origin> of a node (4, 4): xyz [m] and fixed-axis roll, pitch, yaw [rad]; identity without one."""
    origin = node.one("origin")
    if origin is None:
        return np.eye(4)
    xyz, rpy = origin.numbers("xyz", 3, default=(0, 0, 0)), origin.numbers("rpy", 3, default=(0, 0, 0))
    return make_transform(Rotation.from_euler("xyz", rpy).as_matrix(), xyz)


class _Shape(Protocol):
    """A geometry in its own frame, as it is seen and as it collides."""

    def seen(self) -> list[Mesh]: ...

    def touched(self, T: Float) -> list[CollisionPiece]: ...


@dataclass(frozen=True, eq=False)
class _Primitive:
    """A box, cylinder (along z) or sphere, sized as MuJoCo sizes it."""

    shape: str
    size_m: tuple[float, ...]

    def seen(self) -> list[Mesh]:
        if self.shape == "box":
            return [_box(np.array(self.size_m))]
        angles = np.linspace(-np.pi / 2, np.pi / 2, RIM_SEGMENTS // 2 + 1)
        r = self.size_m[0]
        if self.shape == "sphere":
            return [_revolved(r * np.cos(angles), r * np.sin(angles))]
        h = self.size_m[1]
        return [_revolved(np.array([0.0, r, r, 0.0]), np.array([-h, -h, h, h]))]

    def touched(self, T: Float) -> list[CollisionPiece]:
        w, x, y, z = (float(v) for v in quat_wxyz(T[:3, :3]))
        px, py, pz = (float(v) for v in T[:3, 3])
        shape = "box" if self.shape == "box" else "sphere" if self.shape == "sphere" else "cylinder"
        return [CollisionPiece(shape, self.size_m, (px, py, pz), (w, x, y, z))]


@dataclass(frozen=True, eq=False)
class _MeshShape:
    """The meshes of a file, scaled."""

    meshes: tuple[Mesh, ...]
    node: Node
    path: Path

    def seen(self) -> list[Mesh]:
        return list(self.meshes)

    def touched(self, T: Float) -> list[CollisionPiece]:
        pieces: list[CollisionPiece] = []
        for mesh in self.meshes:
            try:
                parts = convex_parts(transformed(mesh, T, np.ones(3)))
            except InputError as error:
                raise self.node.error(f"{self.path.name}: {error}") from error
            if parts.filled:
                warnings.warn(
                    f"{self.node.where}: {self.path.name} is not convex; its hollows are filled. For the true shape "
                    "install CoACD (pip install coacd) or give convex pieces, one `o` group each",
                    stacklevel=2,
                )
            pieces += [CollisionPiece("hull", points_m=hull) for hull in parts.hulls]
        return pieces


def _shape(holder: Node, folder: Path) -> _Shape:
    geometry = holder.need("geometry")
    if len(geometry.children) != 1:
        raise geometry.error(f"<geometry> must hold one shape, found {len(geometry.children)}")
    node = geometry.children[0]
    if node.tag == "box":
        return _Primitive("box", tuple(float(s) / 2 for s in node.numbers("size", 3, positive=True)))
    if node.tag == "sphere":
        return _Primitive("sphere", (float(node.numbers("radius", 1, positive=True)[0]),))
    if node.tag == "cylinder":
        radius, length = (float(node.numbers(k, 1, positive=True)[0]) for k in ("radius", "length"))
        return _Primitive("cylinder", (radius, length / 2))
    if node.tag == "mesh":
        return _mesh_shape(node, folder)
    raise node.error(f"unknown geometry <{node.tag}>; allowed are mesh, box, cylinder and sphere")


def _mesh_shape(node: Node, folder: Path) -> _MeshShape:
    name = node.text("filename")
    if "://" in name or Path(name).is_absolute():
        raise node.error(f"mesh {name!r} must be a path relative to {folder.name}/")
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise node.error(f"mesh {name!r} leads out of the object's folder")
    if not path.is_file():
        near = ", ".join(sorted(p.name for p in folder.iterdir() if p.is_file())) or "none"
        raise node.error(f"mesh {name!r} does not exist; files in {folder.name}/ are {near}")
    scale = node.numbers("scale", 3, default=(1, 1, 1))
    if (scale == 0).any():
        raise node.error(f"scale must not be zero, got {node.text('scale')!r}")
    try:
        meshes = read_mesh(path)
    except InputError as error:
        raise node.error(f"mesh cannot be used: {error}") from error
    return _MeshShape(tuple(transformed(m, np.eye(4), scale) for m in meshes), node, path)


def _visuals(
    node: Node, T_base_link: Float, folder: Path, materials: dict[str, Node], prefix: str
) -> Iterator[VisualPiece]:
    T = T_base_link @ _origin(node)
    part = f"{prefix}{node.text('name', 'body')}"
    color = _color(node, materials)
    for mesh in _shape(node, folder).seen():
        placed = transformed(mesh, T, np.ones(3))
        yield VisualPiece(part, placed.vertices.astype(np.float32), placed.faces.astype(np.int32), color)


def _collisions(node: Node, T_base_link: Float, folder: Path) -> list[CollisionPiece]:
    return _shape(node, folder).touched(T_base_link @ _origin(node))


def _color(visual: Node, materials: dict[str, Node]) -> tuple[float, float, float]:
    material = visual.one("material")
    if material is None:
        return DEFAULT_RGB
    if material.one("color") is None:
        name = material.text("name")
        if name not in materials:
            raise material.error(f"material {name!r} has no <color rgba=...>, here or under <robot>")
        material = materials[name]
    r, g, b, _ = material.need("color").numbers("rgba", 4, within=(0, 1))
    return float(r), float(g), float(b)


def _colors(visuals: list[VisualPiece]) -> tuple[str, ...]:
    """Name the colours of the materials, the one on the most surface first."""
    area: dict[str, float] = {}
    for v in visuals:
        a, b, c = (v.vertices[v.faces[:, i]] for i in range(3))
        rgb = np.round(255 * np.array([v.color])).astype(np.uint8)
        name = name_colors(lab_from_rgb(rgb))[0][0]
        area[name] = area.get(name, 0.0) + float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
    return tuple(sorted(area, key=lambda name: -area[name]))


def _mass(robot: Node, links: list[Node]) -> float:
    total = 0.0
    for link in links:
        inertial = link.one("inertial")
        mass = None if inertial is None else inertial.one("mass")
        if mass is not None:
            total += float(mass.numbers("value", 1, positive=True)[0])
        elif link.all("collision"):
            raise link.error(f'link {link.text("name")!r} has no mass; add <inertial><mass value="0.1"/></inertial>')
    if not 0 < total < 50:
        raise robot.error(f"the mass must lie in (0, 50) kg, got {total:g}; masses are in kilogrammes")
    return total


def _friction(links: list[Node]) -> float:
    for link in links:
        contact = link.one("contact")
        node = None if contact is None else contact.one("lateral_friction")
        if node is not None:
            return float(node.numbers("value", 1, within=(0.01, 4.99))[0])
    return DEFAULT_FRICTION


def _center_of_fitting_size(visuals: list[VisualPiece], robot: Node) -> Float:
    """Return the middle (3,) of what is seen, after a look at its size."""
    points = np.concatenate([v.vertices for v in visuals]).astype(np.float64)
    low, high = points.min(axis=0), points.max(axis=0)
    longest = float((high - low).max())
    smallest, largest = LONGEST_SIDE_M
    if not smallest <= longest <= largest:
        hint = ' Meshes in millimetres need scale="0.001 0.001 0.001".' if longest > largest else ""
        raise robot.error(
            f"the longest side is {longest:g} m; it must lie in {smallest} to {largest} m. Lengths are in metres.{hint}"
        )
    return (low + high) / 2


def _box(half: Float) -> Mesh:
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    faces = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    return Mesh(corners, np.array([t for a, b, c, d in faces for t in ((a, b, c), (a, c, d))], np.int64))


def _revolved(radius: Float, z: Float) -> Mesh:
    """Turn a profile, from the axis at the bottom to the axis at the top, around z."""
    angle = 2 * np.pi * np.arange(RIM_SEGMENTS) / RIM_SEGMENTS
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = np.concatenate(
        [np.concatenate([r * ring, np.full((RIM_SEGMENTS, 1), h)], axis=1) for r, h in zip(radius, z, strict=True)]
    )
    i = np.arange(RIM_SEGMENTS)
    j = (i + 1) % RIM_SEGMENTS
    faces: list[NDArray[np.int64]] = []
    for k in range(len(radius) - 1):
        a, b = k * RIM_SEGMENTS, (k + 1) * RIM_SEGMENTS
        if radius[k] > 1e-9:
            faces.append(np.stack([a + i, a + j, b + j], axis=1))
        if radius[k + 1] > 1e-9:
            faces.append(np.stack([a + i, b + j, b + i], axis=1))
    return Mesh(points, np.concatenate(faces))
