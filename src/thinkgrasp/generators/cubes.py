"""Where to put the upright cubes that a volumetric network looks at."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import ConfigError
from thinkgrasp.generators.surface import Float, Upright
from thinkgrasp.geometry import make_transform
from thinkgrasp.types import Scene, SupportPlane

USABLE = 2 / 3
"""Share of a cube's side, in its middle, that one cube answers for; more is covered by several."""
_AROUND_M = 0.15
_LOWEST_SHARE = 0.02


def supported(scene: Scene, points: Float) -> Scene:
    """Return the scene with a support plane: its own, or a level one that is as low as what is seen around the points.

    Args:
        scene: As perceived.
        points: (N, 3) [m], camera frame, N >= 1.

    Raises:
        ConfigError: Neither support nor camera pose is known, so that there is no telling where up is.
    """
    if scene.support is not None:
        return scene
    T = scene.frame.T_world_camera
    if T is None:
        raise ConfigError(
            "VGN needs to know where up is: this scene has neither a support plane nor T_world_camera; "
            "give T_world_camera in camera.json, or use the antipodal generator"
        )
    up = T[2, :3]
    level = np.stack([T[0, :3], T[1, :3]], axis=1).astype(np.float32)
    seen = scene.points[np.isfinite(scene.points[..., 2])]
    at, wanted = seen @ level, points @ level
    near = ((at >= wanted.min(axis=0) - _AROUND_M) & (at <= wanted.max(axis=0) + _AROUND_M)).all(axis=1)
    offset = -float(np.quantile(seen[near].astype(np.float64) @ up, _LOWEST_SHARE))
    return replace(scene, support=SupportPlane(up, offset, np.zeros(scene.frame.depth.shape, np.bool_), np.inf))


def place_cubes(
    points: Float, upright: Upright, *, side_m: float, support_m: float, yaws_rad: tuple[float, ...], max_cubes: int
) -> list[NDArray[np.float64]]:
    """Cover points with upright cubes whose middles overlap the least.

    The points' bounding rectangle, seen from above, is cut into equal cells no larger than the cubes' usable middle;
    every cell that holds points gets a cube, centred on it.

    Args:
        points: (N, 3) [m], camera frame, N >= 1.
        upright: Up and away directions, and the support.
        side_m: Side of the cubes.
        support_m: Height of the support in the cubes.
        yaws_rad: Turns about the vertical; at 0 the cube's x axis points away from the camera. Each turn covers all.
        max_cubes: At most so many for each turn; the ones with the most points stay.

    Returns:
        T_camera_task (4, 4) of each cube; its origin is the lower corner, z is up.
    """
    up = upright.up.astype(np.float64)
    ahead = upright.away.astype(np.float64)
    left = np.cross(up, ahead)
    cubes: list[NDArray[np.float64]] = []
    for yaw in yaws_rad:
        x = np.cos(yaw) * ahead + np.sin(yaw) * left
        axes = np.stack([x, np.cross(up, x)])
        level = points.astype(np.float64) @ axes.T
        low, high = level.min(axis=0), level.max(axis=0)
        n = np.maximum(np.ceil((high - low) / (USABLE * side_m) - 1e-9), 1)
        pitch = np.maximum((high - low) / n, 1e-9)
        cell = np.minimum(np.floor((level - low) / pitch), n - 1)
        cells, counts = np.unique(cell, axis=0, return_counts=True)
        fullest = np.sort(np.argsort(-counts, kind="stable")[:max_cubes])
        for centre in low + (cells[fullest] + 0.5) * pitch:
            corner = (centre - side_m / 2) @ axes + (-upright.offset_m - support_m) * up
            cubes.append(make_transform(np.stack([*axes, up], axis=1), corner))
    return cubes
