"""Colour, depth and geom ids of a MuJoCo world by ray casting on the CPU: no GL, bit-equal on every run.

Light is computed in linear RGB and encoded as sRGB, so that a surface in the shade keeps its hue.
"""

# pyright: reportAttributeAccessIssue=false
# MuJoCo's module is compiled and has no stubs.

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from thinkgrasp.sim.objects import VisualPiece
from thinkgrasp.sim.rays import ROBOT_GROUP, STATIC_GROUP, THREADS, Hits, cast
from thinkgrasp.sim.shadows import cosine_to, reached_by, soften
from thinkgrasp.sim.textures import LINEAR_FROM_SRGB, sample
from thinkgrasp.sim.views import CameraView

Array = NDArray[np.float32]
Float = NDArray[np.float64]

FAR_M = 6.0
"""Nothing is seen beyond this depth."""
BACKGROUND = (0.60, 0.62, 0.64)
"""sRGB 0..1 where nothing is hit."""
_ROBOT_GLOSS, _STATIC_GLOSS = 0.35, 0.08
_GRAIN_PERIOD_M, _GRAIN_TEXELS = 0.512, 256


@dataclass(frozen=True)
class Light:
    """One lamp over the table and the light that the room throws back; strengths are in linear light."""

    position: tuple[float, float, float] = (1.15, -0.75, 1.45)
    """World [m]."""
    key: float = 0.68
    sky: float = 0.34
    """From above; surfaces that face down get half."""
    fill: float = 0.14
    """From the camera's side, without shadow."""


@dataclass(frozen=True, eq=False)
class Rendering:
    """What a camera sees, exactly."""

    color: NDArray[np.uint8]
    """(H, W, 3) sRGB."""
    depth: Array
    """(H, W) [m] along the optical axis; 0 = nothing hit."""
    geoms: NDArray[np.int32]
    """(H, W) geom id, -1 = nothing hit."""
    normals: Array
    """(H, W, 3) unit, towards the camera, world frame; 0 where nothing was hit."""

    def cosine(self, view: CameraView) -> Array:
        """Return the cosine (H, W) between the surface's normal and the ray; 0 where nothing was hit."""
        towards = -_unit(view.rays.astype(np.float32)).reshape(self.normals.shape)
        return np.clip(np.einsum("hwi,hwi->hw", self.normals, towards), 0, 1)


def render(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    view: CameraView,
    visuals: Mapping[int, VisualPiece],
    *,
    shadows: bool = True,
    light: Light | None = None,
    hits: Hits | None = None,
    threads: int = THREADS,
) -> Rendering:
    """Render the geoms of groups 0, 1 and 2.

    Args:
        model: The world.
        data: Its state, forwarded.
        view: Camera and pose.
        visuals: Geom id -> its colours, placed in the frame of the geom's body; other geoms take `model.geom_rgba`.
        shadows: Whether the lamp throws shadows; their edges are softened on static things.
        light: Where the lamp is and how strong; None = Light().
        hits: What the view's rays meet, normals included, where that is known; None = they are cast.
        threads: Upper limit; the result does not depend on it.
    """
    if hits is None:
        hits = cast(model, data, view.eye, view.rays, normals=True, threads=threads)
    seen = Surfaces(hits.geoms, hits.distances, hits.normals)
    return shade(model, data, view, visuals, seen, shadows=shadows, light=light, threads=threads)


@dataclass(frozen=True, eq=False)
class Surfaces:
    """What each of the H*W pixels shows, row by row, before light."""

    geoms: NDArray[np.int32]
    """(H*W,) geom id, -1 = nothing."""
    depth: Float
    """(H*W,) [m]."""
    normals: Float
    """(H*W, 3) unit, world, on either side of the surface."""


def shade(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    view: CameraView,
    visuals: Mapping[int, VisualPiece],
    seen: Surfaces,
    *,
    shadows: bool,
    light: Light | None,
    threads: int,
) -> Rendering:
    """Give surfaces their colours and their light; arguments as in `render`."""
    light = light or Light()
    c = view.intrinsics
    index = np.flatnonzero((seen.geoms >= 0) & (seen.depth > 0) & (seen.depth <= FAR_M))
    geoms, rays, distance = seen.geoms[index], view.rays[index], seen.depth[index]
    points = view.eye + distance[:, None] * rays
    normals = seen.normals[index]
    normals[np.einsum("ni,ni->n", normals, rays) > 0] *= -1
    lamp = np.asarray(light.position, np.float64)
    facing = cosine_to(lamp, points, normals)
    if shadows:
        reached = reached_by(lamp, model, data, points, facing > 0, threads=threads)
        soften(reached, model.geom_group[geoms] == STATIC_GROUP, index, (c.height, c.width))
        facing *= reached
    albedo, gloss = _materials(model, data, view, visuals, geoms, points, normals, distance)

    color = np.empty((c.height, c.width, 3), np.uint8)
    color[:] = np.round(np.asarray(BACKGROUND) * 255)
    depth = np.zeros((c.height, c.width), np.float32)
    ids = np.full((c.height, c.width), -1, np.int32)
    towards = np.zeros((c.height, c.width, 3), np.float32)
    color.reshape(-1, 3)[index] = _encode(_radiance(view, light, points, normals, facing, albedo, gloss))
    depth.reshape(-1)[index] = distance
    ids.reshape(-1)[index] = geoms
    towards.reshape(-1, 3)[index] = normals
    return Rendering(color, depth, ids, towards)


def _materials(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    view: CameraView,
    visuals: Mapping[int, VisualPiece],
    geoms: NDArray[np.int32],
    points: Float,
    normals: Float,
    depth: Float,
) -> tuple[Array, Array]:
    """Linear albedo (N, 3) and gloss (N,) of the points."""
    palette = _linear(model.geom_rgba[:, :3])
    glosses = np.where(model.geom_group == ROBOT_GROUP, _ROBOT_GLOSS, _STATIC_GLOSS).astype(np.float32)
    for geom, piece in visuals.items():
        palette[geom] = _linear(np.asarray(piece.color))
        glosses[geom] = piece.gloss
    albedo = palette[geoms]

    static = np.flatnonzero(model.geom_group[geoms] == STATIC_GROUP)
    cell = (points[static, :2] * (_GRAIN_TEXELS / _GRAIN_PERIOD_M)).astype(np.int64) % _GRAIN_TEXELS
    albedo[static] *= _GRAIN[cell[:, 1], cell[:, 0], None]

    seen = np.bincount(geoms, minlength=model.ngeom)
    for geom in np.flatnonzero(seen).tolist():
        texture = visuals[geom].texture if geom in visuals else None
        if texture is None:
            continue
        own = np.flatnonzero(geoms == geom)
        body = model.geom_bodyid[geom]
        R = data.xmat[body].reshape(3, 3)
        local = _rotate((points[own] - data.xpos[body]).astype(np.float32), R)
        pixel_m = float(np.median(depth[own])) / view.intrinsics.fx
        albedo[own] = sample(texture, local, _rotate(normals[own].astype(np.float32), R), pixel_m)
    return albedo, glosses[geoms]


def _rotate(vectors: Array, R: Float) -> Array:
    """R transposed times each vector (N, 3), in a fixed order of operations."""
    m = R.astype(np.float32)
    return vectors[:, :1] * m[0] + vectors[:, 1:2] * m[1] + vectors[:, 2:] * m[2]


def _radiance(
    view: CameraView, light: Light, points: Float, normals: Float, lit: Array, albedo: Array, gloss: Array
) -> Array:
    """Linear radiance (N, 3): Lambert from lamp, sky and fill, and a Blinn-Phong highlight."""
    n = normals.astype(np.float32)
    to_eye = _unit((view.eye - points).astype(np.float32))
    to_lamp = _unit((np.asarray(light.position) - points).astype(np.float32))
    half = _unit(to_eye + to_lamp)
    level = np.float32(light.sky) * (np.float32(0.75) + np.float32(0.25) * n[:, 2])
    level += np.float32(light.fill) * np.maximum(np.einsum("ni,ni->n", n, to_eye), 0)
    level += np.float32(light.key) * lit
    shine = np.maximum(np.einsum("ni,ni->n", n, half), 0) ** (8 + 90 * gloss)
    highlight = np.float32(0.35) * gloss * shine * (lit > 0)
    return albedo * level[:, None] + highlight[:, None]


def _unit(vectors: Array) -> Array:
    return vectors / np.sqrt(np.einsum("ni,ni->n", vectors, vectors))[:, None]


def _linear(srgb: NDArray[np.floating]) -> Array:
    return LINEAR_FROM_SRGB[np.round(np.clip(srgb, 0, 1) * 255).astype(np.uint8)]


_STEPS = np.arange(4096) / 4095
_SRGB_FROM_LINEAR = np.round(
    255 * np.where(_STEPS <= 0.0031308, 12.92 * _STEPS, 1.055 * _STEPS ** (1 / 2.4) - 0.055)
).astype(np.uint8)


def _encode(linear: Array) -> NDArray[np.uint8]:
    return _SRGB_FROM_LINEAR[(np.clip(linear, 0, 1) * np.float32(4095)).astype(np.int16)]


def _grain() -> Array:
    """A tile of table surface: fine and coarse blotches around 1, alike on every machine."""
    noise = np.random.default_rng(515).standard_normal((_GRAIN_TEXELS, _GRAIN_TEXELS))
    fine, coarse = (ndimage.gaussian_filter(noise, sigma, mode="wrap") for sigma in (0.7, 6.0))
    return (1 + 0.02 * fine / fine.std() + 0.015 * coarse / coarse.std()).astype(np.float32)


_GRAIN = _grain()
