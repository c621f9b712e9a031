"""Which of the points that a camera sees a lamp reaches."""

# pyright: reportAttributeAccessIssue=false
# MuJoCo's module is compiled and has no stubs.

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from thinkgrasp.sim.rays import SEEN_GROUPS, THREADS, cast

Array = NDArray[np.float32]
Float = NDArray[np.float64]

_BIAS_M = 0.0015
"""Surfaces nearer to a point than this are the point's own."""
_PENUMBRA = 0.004
"""Blur of shadows on static things, as a share of the image's height."""
_CELLS, _SPAN = 192, 1.6
"""The lamp's view straight down: cells across, and tangent of half its angle; the outer cells hold all beyond."""
_CORNERS = np.stack(np.meshgrid([-1.0, 1], [-1.0, 1], [-1.0, 1], indexing="ij"), axis=-1).reshape(8, 3)


def cosine_to(lamp: Float, points: Float, normals: Float) -> Array:
    """Return the cosine between each normal (N, 3) and the direction to a lamp (3,), (N,); 0 where it is behind."""
    beams = lamp - points
    length = np.sqrt(np.einsum("ni,ni->n", beams, beams))
    return np.maximum(np.einsum("ni,ni->n", beams, normals) / length, 0).astype(np.float32)


def reached_by(
    lamp: Float,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    points: Float,
    ask: NDArray[np.bool_],
    *,
    cull: bool = True,
    threads: int = THREADS,
) -> Array:
    """Return 1 for points that nothing hides from a lamp, 0 for the others, (N,).

    Args:
        lamp: (3,) world [m].
        model: The world.
        data: Its state, forwarded.
        points: (N, 3) on its surfaces, world [m].
        ask: (N,) False = do not look; such points count as reached.
        cull: Whether to cast rays only where something stands in the way of the lamp; the result is the same.
        threads: Upper limit.
    """
    reached = np.ones(len(points), np.float32)
    index = np.flatnonzero(ask & _may_be_hidden(lamp, model, data, points)) if cull else np.flatnonzero(ask)
    beams = points[index] - lamp
    hits = cast(model, data, lamp, beams, threads=threads)
    short = (1 - hits.distances) * np.sqrt(np.einsum("ni,ni->n", beams, beams))
    reached[index[(hits.geoms >= 0) & (short > _BIAS_M)]] = 0
    return reached


def _may_be_hidden(lamp: Float, model: mujoco.MjModel, data: mujoco.MjData, points: Float) -> NDArray[np.bool_]:
    """False where nothing in the lamp's direction reaches higher than the point (N,).

    A beam never runs below both its ends, so only what reaches above the lower one can stop it. The tops of all geoms'
    boxes are drawn into a picture seen from the lamp, the highest kept.
    """
    geoms = np.flatnonzero(np.isin(model.geom_group, SEEN_GROUPS))
    center, half = model.geom_aabb[geoms, None, :3], model.geom_aabb[geoms, None, 3:]
    R = data.geom_xmat[geoms].reshape(-1, 3, 3)
    corners = np.einsum("gij,gcj->gci", R, center + half * _CORNERS) + data.geom_xpos[geoms, None]
    tops = corners[..., 2].max(axis=1)
    cell, below = _cells(lamp, corners)
    low, high = cell.min(axis=1), cell.max(axis=1) + 1
    everywhere = ~below.all(axis=1) | (model.geom_type[geoms] == mujoco.mjtGeom.mjGEOM_PLANE)
    low[everywhere], high[everywhere] = 0, _CELLS
    highest = np.full((_CELLS, _CELLS), -np.inf)
    for top, (x0, y0), (x1, y1) in zip(tops.tolist(), low.tolist(), high.tolist(), strict=True):
        np.maximum(highest[y0:y1, x0:x1], top, out=highest[y0:y1, x0:x1])
    cell, below = _cells(lamp, points)
    return ~below | (highest[cell[:, 1], cell[:, 0]] > points[:, 2] + 1e-6)


def _cells(lamp: Float, points: Float) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Cells (..., 2) of points (..., 3) in the lamp's view, and whether they are below the lamp at all (...)."""
    d = points - lamp
    depth = -d[..., 2]
    below = depth > 1e-3
    tangent = d[..., :2] / np.where(below, depth, 1.0)[..., None]
    cell = (tangent + _SPAN) * (_CELLS / (2 * _SPAN))
    return np.clip(cell, 0, _CELLS - 1).astype(np.intp), below


def soften(reached: Array, static: NDArray[np.bool_], index: NDArray[np.intp], size_hw: tuple[int, int]) -> None:
    """Blur, in place, the edges of the shadows on static surfaces, without looking at other pixels.

    Args:
        reached: (N,) 1 = lit, 0 = in shadow.
        static: (N,) whether the pixel shows a static thing.
        index: (N,) flat index of the pixel in the image.
        size_hw: Height and width of the image.
    """
    on = index[static]
    blurred = []
    for values in (reached[static], 1):
        image = np.zeros(size_hw, np.float32)
        image.reshape(-1)[on] = values
        image = ndimage.gaussian_filter(image, _PENUMBRA * size_hw[0], truncate=2.0, mode="constant")
        blurred.append(image.reshape(-1)[on])
    reached[static] = blurred[0] / blurred[1]
