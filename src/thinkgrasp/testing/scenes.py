"""Small scenes with known truth, rendered once per process."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.geometry import apply, deproject, invert, make_transform
from thinkgrasp.sim.tabletop import Rendering, TabletopScene, demo_camera, demo_scene, render
from thinkgrasp.types import CameraIntrinsics, Frame, Grasps, Mask, Proposal, Scene, SupportPlane

_LEAST_PIXELS = 30
_LOOKS = {
    "red cracker box": ("red", "box-like"),
    "tomato soup can": ("red", "cylindrical"),
    "white mug": ("white", "hollow"),
    "banana": ("yellow", "elongated"),
    "green bowl": ("green", "hollow"),
    "purple ball": ("purple", "round"),
    "pudding box": ("brown", "flat"),
    "blue cup": ("blue", "cylindrical"),
    "marker": ("blue", "elongated"),
    "drill": ("orange", "elongated"),
}
"""Colour name and leading shape of the things in the demonstration scene."""


@cache
def sample_frame(*, things: bool = True, pose: bool = True, dropout: float = 0.0) -> Frame:
    """Return a 320x240 view of a table with ten household things (or none), as a depth camera would see it."""
    frame = _rendering(things, dropout).frame
    return frame if pose else replace(frame, T_world_camera=None)


@cache
def sample_scene() -> Scene:
    """Return the scene of `sample_frame()` as a perfect perception would report it, without an obstruction graph."""
    rendering = _rendering(True, 0.0)
    frame, T = rendering.frame, rendering.frame.T_world_camera
    assert T is not None  # the renderer always knows it
    points = deproject(frame.depth, frame.camera)
    heights = apply(T, points)[..., 2]
    up = T[:3, :3].T @ np.array([0.0, 0.0, 1.0])
    table = np.isfinite(heights) & (np.abs(heights) < 0.01) & (rendering.labels < 0)
    support = SupportPlane(up, float(T[2, 3]), table, float(np.median(np.abs(heights[table]))))
    proposals: list[Proposal] = []
    names = [thing.name for thing in demo_scene(0).objects]
    for index in range(len(names)):
        mask = rendering.mask(index) & np.isfinite(points[..., 2])
        if mask.sum() >= _LEAST_PIXELS:
            proposals.append(_proposal(len(proposals) + 1, mask, points, T, names[index]))
    region = np.logical_or.reduce([p.mask for p in proposals])
    return Scene(frame, points, _normals(points), support, region, tuple(proposals))


@cache
def empty_scene() -> Scene:
    """Return a bare table: a frame and its points, no proposals."""
    frame = sample_frame(things=False)
    return Scene(frame, deproject(frame.depth, frame.camera))


@cache
def strict_scene() -> Scene:
    """Return the things of `sample_frame()` in the paper's strict mode: frame and points only."""
    frame = sample_frame()
    return Scene(frame, deproject(frame.depth, frame.camera))


def top_down_grasps(scene: Scene, proposal: Proposal, n: int = 24) -> Grasps:
    """Return n grasps from above on a proposal of `sample_scene`, their closing directions spread at random."""
    points = scene.points[proposal.mask & np.isfinite(scene.points[..., 2])]
    rng = np.random.default_rng(0)
    assert scene.support is not None  # sample_scene always has one
    z = -scene.support.normal
    rotations: list[NDArray[np.float64]] = []
    for angle in rng.uniform(0, np.pi, n):
        side = np.cross(z, [1.0, 0.0, 0.0])
        x = side / np.linalg.norm(side)
        x = float(np.cos(angle)) * x + float(np.sin(angle)) * np.cross(z, x)
        rotations.append(np.stack([x, np.cross(z, x), z], axis=1))
    return Grasps(
        np.array(rotations, np.float32),
        points[rng.integers(0, len(points), n)],
        rng.uniform(0.01, 0.12, n).astype(np.float32),
        rng.uniform(0, 1, n).astype(np.float32),
    )


@cache
def _rendering(things: bool, dropout: float) -> Rendering:
    full, T = demo_camera()
    camera = CameraIntrinsics(320, 240, full.fx / 2, full.fy / 2, 159.5, 119.5)
    scene = demo_scene(0) if things else TabletopScene(())
    return render(scene, camera, T, rng=np.random.default_rng(0), dropout=dropout)


def _proposal(mark: int, mask: Mask, points: NDArray[np.float32], T: NDArray[np.float64], name: str) -> Proposal:
    world = apply(T, points[mask].astype(np.float64))
    low, high = np.minimum(world.min(axis=0), [np.inf, np.inf, 0.0]), world.max(axis=0)
    sides = np.maximum(high - low, 1e-3)
    order = np.argsort(-sides, kind="stable")
    axes = np.eye(3)[:, order]
    if np.linalg.det(axes) < 0:
        axes[:, 2] *= -1
    T_camera_object = invert(T) @ make_transform(axes, (low + high) / 2)
    v, u = np.nonzero(mask)
    box = int(u.min()), int(v.min()), int(u.max()) + 1, int(v.max()) + 1
    border = box[0] == 0 or box[1] == 0 or box[2] == mask.shape[1] or box[3] == mask.shape[0]
    extents = float(sides[order[0]]), float(sides[order[1]]), float(sides[order[2]])
    color, shape = _LOOKS.get(name, ("grey", "box-like"))
    height = float(world[:, 2].min()), float(world[:, 2].max())
    return Proposal(mark, mask, box, extents, T_camera_object, height, ((color, 1.0),), ((shape, 1.0),), border, 1.0)


def _normals(points: NDArray[np.float32]) -> NDArray[np.float32]:
    across = np.full_like(points, np.nan)
    down = np.full_like(points, np.nan)
    across[:, 1:-1] = points[:, 2:] - points[:, :-2]
    down[1:-1] = points[2:] - points[:-2]
    normals = np.cross(down, across)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        normals = normals / length
        towards = (normals * points).sum(axis=-1, keepdims=True) <= 0
    return np.where(towards, normals, -normals).astype(np.float32)
