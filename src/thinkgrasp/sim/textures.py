"""Colour of a surface point by its position in the object frame."""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.sim.objects import Texture

Array = NDArray[np.float32]

_LEVELS = np.arange(256) / 255
LINEAR_FROM_SRGB: Array = np.where(_LEVELS <= 0.04045, _LEVELS / 12.92, ((_LEVELS + 0.055) / 1.055) ** 2.4).astype(
    np.float32
)
"""(256,) linear light of an 8-bit sRGB level."""

_pyramids: WeakKeyDictionary[Texture, list[Array]] = WeakKeyDictionary()


def sample(texture: Texture, points: Array, normals: Array, pixel_m: float) -> Array:
    """Return the linear RGB (N, 3) of a texture at surface points.

    Args:
        texture: What to look up.
        points: (N, 3) object frame [m].
        normals: (N, 3) unit, outward, object frame; they choose the side of a "box".
        pixel_m: Size of a camera pixel on the surface; finer detail is averaged away.
    """
    uv, span_m = _coordinates(texture, points, normals)
    levels = _pyramid(texture)
    texel_m = span_m / max(texture.image.shape[:2])
    level = levels[int(np.clip(np.floor(np.log2(max(pixel_m / texel_m, 1.0))), 0, len(levels) - 1))]
    return _bilinear(level, uv)


def _bilinear(image: Array, uv: Array) -> Array:
    """Colours (N, 3) between the four nearest texels of an image (h, w, 3), at coordinates in 0..1."""
    h, w = image.shape[:2]
    x = np.clip(uv[:, 0] * np.float32(w) - np.float32(0.5), 0, w - 1)
    y = np.clip(uv[:, 1] * np.float32(h) - np.float32(0.5), 0, h - 1)
    x0, y0 = x.astype(np.int32), y.astype(np.int32)
    x1, y1 = np.minimum(x0 + 1, w - 1), np.minimum(y0 + 1, h - 1)
    a, b = (x - x0.astype(np.float32))[:, None], (y - y0.astype(np.float32))[:, None]
    upper = image[y0, x0] + a * (image[y0, x1] - image[y0, x0])
    lower = image[y1, x0] + a * (image[y1, x1] - image[y1, x0])
    return (upper + b * (lower - upper)).astype(np.float32)


def _coordinates(texture: Texture, points: Array, normals: Array) -> tuple[Array, float]:
    """Texture coordinates (N, 2) in 0..1 (columns, rows), and the length [m] that the image's longer side covers."""
    low, high = texture.bounds_m.astype(np.float32)
    size = np.maximum(high - low, np.float32(1e-6))
    if texture.projection == "box":
        return _box_coordinates((points - low) / size, normals), float(size.max())
    centred = (points - (low + high) / 2) / (size / 2)
    turn = np.arctan2(centred[:, 0], -centred[:, 1]) / np.float32(2 * np.pi)
    turn = np.where(turn < 0, turn + np.float32(1), turn)
    if texture.projection == "cylinder":
        row = (np.float32(1) - centred[:, 2]) / 2
    else:
        radius = np.sqrt(np.einsum("ni,ni->n", centred, centred))
        row = np.arccos(np.clip(centred[:, 2] / np.maximum(radius, np.float32(1e-6)), -1, 1)) / np.float32(np.pi)
    return np.stack([turn, row], axis=1), float(np.pi * max(size[0], size[1]))


def _box_coordinates(unit: Array, normals: Array) -> Array:
    """Each side carries the image so that it reads from outside; `unit` is the position 0..1 in the bounds."""
    axis = np.argmax(np.abs(normals), axis=1)
    positive = np.take_along_axis(normals, axis[:, None], axis=1)[:, 0] > 0
    x, y, z = unit.T
    one = np.float32(1)
    column = np.select(
        [(axis == 0) & positive, axis == 0, (axis == 1) & positive, axis == 1, positive],
        [y, one - y, one - x, x, x],
        one - x,
    )
    return np.stack([column, np.where(axis == 2, one - y, one - z)], axis=1)


def _pyramid(texture: Texture) -> list[Array]:
    """The image in linear light, and halved again and again."""
    levels = _pyramids.get(texture)
    if levels is None:
        levels = [LINEAR_FROM_SRGB[texture.image]]
        while min(levels[-1].shape[:2]) >= 8:
            last = levels[-1]
            even = last[: last.shape[0] // 2 * 2, : last.shape[1] // 2 * 2]
            levels.append((even[::2, ::2] + even[1::2, ::2] + even[::2, 1::2] + even[1::2, 1::2]) / np.float32(4))
        _pyramids[texture] = levels
    return levels
