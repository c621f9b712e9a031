"""Mesh files: what they show, and the convex pieces that they collide as."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import tempfile
import zipfile
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from thinkgrasp.errors import InputError, MissingDependency

Float = NDArray[np.float64]

FORMATS = (".obj", ".stl", ".ply", ".dae")
MAX_HULL_POINTS = 64
CONVEX_SHARE = 0.93
"""A closed mesh that fills this share of its convex hull collides as the hull."""
COACD_THRESHOLD = 0.05
COACD_MAX_PIECES = 24
_COACD_VERSION = 1
"""Part of the cache's key; raise it when the call to CoACD changes."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh: vertices (V, 3) float64 and faces (F, 3) int64, counter-clockwise seen from outside."""

    vertices: Float
    faces: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class ConvexParts:
    """Convex pieces of a mesh."""

    hulls: tuple[Float, ...]
    """Corners (P, 3) of each piece, P <= MAX_HULL_POINTS."""
    filled: bool
    """Whether hollows of a mesh that is not convex were filled, since nothing could decompose it."""


def read_mesh(path: Path) -> tuple[Mesh, ...]:
    """Read a mesh file: one mesh per object of the file (`o` of an OBJ), vertices at one place merged.

    Args:
        path: An .obj, .stl, .ply or .dae file.

    Raises:
        InputError: The file cannot be read, or holds no triangles or numbers that are not finite.
        MissingDependency: trimesh is not installed.
    """
    if path.suffix.lower() not in FORMATS:
        raise InputError(f"{path}: cannot read {path.suffix or 'a mesh without an ending'}; use {', '.join(FORMATS)}")
    trimesh = _trimesh()
    if path.suffix.lower() == ".dae" and not _installed("collada"):
        raise InputError(f"{path}: reading .dae needs pycollada (pip install pycollada), or save the mesh as .obj")
    try:
        scene = trimesh.load_scene(path, process=False, split_object=True, group_material=False, skip_materials=True)
        found = [g for g in scene.dump() if isinstance(g, trimesh.Trimesh) and len(g.faces)]
    except Exception as error:  # the readers raise whatever a broken file leads them to
        raise InputError(f"{path}: not a mesh that can be read ({type(error).__name__}: {error})") from error
    if not found:
        raise InputError(f"{path}: holds no triangles")
    return tuple(_cleaned(g, path) for g in found)


def bounds(meshes: tuple[Mesh, ...]) -> Float:
    """Return the (2, 3) lowest and highest corner."""
    points = np.concatenate([m.vertices for m in meshes])
    return np.stack([points.min(axis=0), points.max(axis=0)])


def transformed(mesh: Mesh, T: Float, scale: Float) -> Mesh:
    """Return the mesh scaled by (3,) along its own axes, then moved by T (4, 4); mirrored faces are turned back."""
    faces = mesh.faces if np.prod(scale) > 0 else mesh.faces[:, ::-1]
    return Mesh((mesh.vertices * scale) @ T[:3, :3].T + T[:3, 3], faces)


def convex_parts(mesh: Mesh) -> ConvexParts:
    """Split a mesh into convex pieces.

    Components of one mesh are judged one by one. One that is not convex is decomposed by CoACD where that package is
    installed (the result is kept in the user's cache folder), else its convex hull fills its hollows.

    Raises:
        InputError: A component has no volume.
    """
    trimesh = _trimesh()
    whole = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    hulls: list[Float] = []
    filled = False
    for component in whole.split(only_watertight=False) if whole.body_count > 1 else [whole]:
        points = np.asarray(component.vertices)
        hull = _hull(points)
        if _fills(component, hull):
            hulls.append(hull_points(points))
        elif _installed("coacd"):
            hulls += _decomposed(Mesh(points, np.asarray(component.faces)))
        else:
            hulls.append(hull_points(points))
            filled = True
    return ConvexParts(tuple(hulls), filled)


def hull_points(points: Float) -> Float:
    """Return at most MAX_HULL_POINTS corners (P, 3) of the convex hull of points (N, 3).

    Of more corners, those are kept that are the farthest in directions spread evenly over the sphere, so that the
    result lies inside the hull.

    Raises:
        InputError: The points span no volume.
    """
    corners = points[_hull(points).vertices]
    if len(corners) <= MAX_HULL_POINTS:
        return corners
    return corners[np.unique((corners @ _directions().T).argmax(axis=0))]


@lru_cache(maxsize=1)
def _directions() -> Float:
    """(MAX_HULL_POINTS, 3) unit vectors: the axes, and the rest on a Fibonacci spiral."""
    n = MAX_HULL_POINTS - 6
    z = 1 - (2 * np.arange(n) + 1) / n
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(n)
    r = np.sqrt(1 - z * z)
    return np.concatenate([np.eye(3), -np.eye(3), np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)])


def _trimesh() -> ModuleType:
    if not _installed("trimesh"):
        raise MissingDependency("trimesh", "sim", "reading meshes")
    return importlib.import_module("trimesh")


@lru_cache(maxsize=8)
def _installed(package: str) -> bool:
    return importlib.util.find_spec(package) is not None


def _cleaned(found: Any, path: Path) -> Mesh:
    if not np.isfinite(found.vertices).all():
        raise InputError(f"{path}: holds coordinates that are not finite numbers")
    found.merge_vertices(merge_tex=True, merge_norm=True)
    if found.is_watertight and found.volume < 0:
        found.invert()
    return Mesh(np.asarray(found.vertices, np.float64), np.asarray(found.faces, np.int64))


def _hull(points: Float) -> ConvexHull:
    try:
        return ConvexHull(points)
    except (QhullError, ValueError) as error:
        raise InputError("a collision mesh is flat: its points span no volume") from error


def _fills(component: Any, hull: ConvexHull) -> bool:
    """Whether a component fills its hull; an open one has no volume to compare."""
    if not component.is_watertight:
        return bool(component.is_convex)
    return abs(component.volume) >= CONVEX_SHARE * hull.volume


def _decomposed(mesh: Mesh) -> list[Float]:
    cache = _cache_file(mesh)
    try:
        with cache.open("rb") as file, np.load(file) as kept:
            return [kept[name] for name in kept.files]
    except (OSError, ValueError, EOFError, zipfile.BadZipFile):
        pass  # not decomposed before, or the cache is broken: decompose again
    coacd = importlib.import_module("coacd")
    coacd.set_log_level("error")
    pieces = coacd.run_coacd(
        coacd.Mesh(mesh.vertices, mesh.faces),
        threshold=COACD_THRESHOLD,
        max_convex_hull=COACD_MAX_PIECES,
        max_ch_vertex=MAX_HULL_POINTS,
        seed=0,
    )
    hulls = [hull_points(np.asarray(vertices, np.float64)) for vertices, _ in pieces]
    _keep(cache, hulls)
    return hulls


def _cache_file(mesh: Mesh) -> Path:
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    key = hashlib.sha256(f"{_COACD_VERSION} {COACD_THRESHOLD} {COACD_MAX_PIECES} {MAX_HULL_POINTS}".encode())
    key.update(np.ascontiguousarray(mesh.vertices).tobytes())
    key.update(np.ascontiguousarray(mesh.faces).tobytes())
    return root / "thinkgrasp" / "convex" / f"{key.hexdigest()[:32]}.npz"


def _keep(cache: Path, hulls: list[Float]) -> None:
    """Write the pieces so that a reader sees all or nothing; a folder that cannot be written costs time only."""
    try:
        cache.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=cache.parent, suffix=".npz", delete=False) as file:
            np.savez(file, *hulls)
        os.replace(file.name, cache)
    except OSError:
        return
