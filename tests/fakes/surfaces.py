"""Organised clouds made point by point: a surface over every pixel, its exact normals, and a colour."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.perception.color import lab_from_rgb
from thinkgrasp.types import Array, Mask

HEIGHT, WIDTH, FOCAL = 144, 192, 240.0


@dataclass(frozen=True, eq=False)
class Sheet:
    """What perception is given of a view."""

    points: Array
    normals: Array
    lab: Array
    mask: Mask


def rays() -> NDArray[np.float64]:
    """Return the directions (H, W, 3) of the pixels, z = 1."""
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    return np.stack([(u - (WIDTH - 1) / 2) / FOCAL, (v - (HEIGHT - 1) / 2) / FOCAL, np.ones_like(u)], axis=-1)


def pixels(where: Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.bool_]]) -> Mask:
    """Return the mask of the pixels (column, row) that answer to a rule."""
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    return where(u, v)


def plane(normal: tuple[float, float, float], through: tuple[float, float, float]) -> tuple[Array, Array]:
    """Return points and normals (H, W, 3) of a plane that fills the view."""
    n = np.array(normal, float) / np.linalg.norm(normal)
    directions = rays()
    with np.errstate(divide="ignore"):
        z = float(n @ np.array(through)) / (directions @ n)
    n = -n if n[2] > 0 else n
    return (directions * z[..., None]).astype(np.float32), np.broadcast_to(n, directions.shape).astype(np.float32)


def cylinder(radius: float, distance: float) -> tuple[Array, Array, Mask]:
    """Return points, normals and the mask of an upright cylinder in front of the camera; NaN beside it."""
    d = rays()
    a = d[..., 0] ** 2 + 1
    root = distance**2 - a * (distance**2 - radius**2)
    hit = root > 0.1 * radius**2
    z = np.where(hit, (distance - np.sqrt(np.maximum(root, 0))) / a, np.nan)
    points = d * z[..., None]
    normals = points - np.array([0.0, 0.0, distance])
    normals[..., 1] = 0
    return points.astype(np.float32), (normals / radius).astype(np.float32), hit


def sheet(points: Array, normals: Array, mask: Mask, rgb: NDArray[np.uint8] | None = None) -> Sheet:
    """Paint a surface; grey when no colour (H, W, 3) is given."""
    color = np.full((HEIGHT, WIDTH, 3), 150, np.uint8) if rgb is None else rgb
    return Sheet(points, normals, lab_from_rgb(color), mask)


def two_colors(left: Mask, first: tuple[int, int, int], second: tuple[int, int, int]) -> NDArray[np.uint8]:
    """Return an image (H, W, 3) in the first colour where the mask is set and the second elsewhere."""
    return np.where(left[..., None], np.array(first, np.uint8), np.array(second, np.uint8))
