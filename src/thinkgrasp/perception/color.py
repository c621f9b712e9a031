"""Perceptual colour: CIE Lab images and the eleven basic colour names."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.types import Array, Mask

_GAMMA = np.where(
    np.arange(256) / 255 <= 0.04045, np.arange(256) / 255 / 12.92, ((np.arange(256) / 255 + 0.055) / 1.055) ** 2.4
).astype(np.float32)
_XYZ_FROM_RGB = np.array(
    [
        [0.4124564, 0.3575761, 0.1804375],
        [0.2126729, 0.7151522, 0.0721750],
        [0.0193339, 0.1191920, 0.9503041],
    ],
    np.float32,
)
_WHITE_D65 = np.array([0.95047, 1.0, 1.08883], np.float32)

COLOR_NAMES = ("red", "orange", "yellow", "green", "blue", "purple", "pink", "brown", "black", "white", "grey")
"""The eleven basic colour terms of English (Berlin and Kay, 1969)."""
MIN_WHITE_PIXELS = 400
MAX_CAST = 0.16
"""Largest shift of a* or b* per unit of lightness that is taken for a cast."""


def lab_from_rgb(rgb: NDArray[np.uint8]) -> Array:
    """Convert sRGB (..., 3) to CIE L*a*b* (..., 3) float32 under D65."""
    t = np.cbrt(_GAMMA[rgb] @ (_XYZ_FROM_RGB / _WHITE_D65[:, None]).T)
    lab = np.empty_like(t)
    lab[..., 0] = 116 * t[..., 1] - 16
    lab[..., 1] = 500 * (t[..., 0] - t[..., 1])
    lab[..., 2] = 200 * (t[..., 1] - t[..., 2])
    return lab


def balance_white(lab: Array, usable: Mask) -> Array:
    """Remove the light's colour cast, judged by the brightest pale pixels among those usable.

    Args:
        lab: (H, W, 3) CIE Lab.
        usable: (H, W) pixels to judge by.

    Returns:
        (H, W, 3) Lab; unchanged where there are too few bright pale pixels to judge by.

    References:
        The white-patch rule: the brightest surface in view is taken to be white. At most MAX_CAST is removed.
    """
    seen = lab[::2, ::2][usable[::2, ::2]]
    bright = seen[(seen[:, 0] > 68) & (np.hypot(seen[:, 1], seen[:, 2]) < 24)]
    if len(bright) < MIN_WHITE_PIXELS // 4:
        return lab
    bright = bright[bright[:, 0] >= np.percentile(bright[:, 0], 50)]
    bright = bright[bright[:, 0] < 99]
    if len(bright) < MIN_WHITE_PIXELS // 16:
        return lab
    cast = np.median(bright[:, 1:] / bright[:, :1], axis=0)
    size = float(np.linalg.norm(cast))
    cast *= min(1.0, MAX_CAST / max(size, 1e-6))
    balanced = lab.copy()
    balanced[..., 1:] -= lab[..., :1] * cast.astype(np.float32)
    return balanced


_HUES: tuple[tuple[str, float, float], ...] = (
    ("red", 2.0, 43.0),
    ("orange", 43.0, 75.5),
    ("yellow", 75.5, 108.0),
    ("green", 108.0, 202.0),
    ("blue", 202.0, 312.0),
    ("purple", 312.0, 340.0),
    ("pink", 340.0, 362.0),
)
"""Hue ranges in Lab [deg] of the seven hue names, chosen on the sRGB colours that carry these names in CSS."""
_HUE_SOFT_DEG = 7.0


def _ramp(x: NDArray[np.floating], low: float, high: float) -> NDArray[np.floating]:
    return np.clip((x - low) / (high - low), 0, 1)


def color_memberships(lab: Array) -> Array:
    """Return how far each Lab colour (N, 3) belongs to each name of COLOR_NAMES, (N, 11); rows sum to 1."""
    L, a, b = lab[:, 0], lab[:, 1], lab[:, 2]
    chroma = np.hypot(a, b)
    hue = np.degrees(np.arctan2(b, a)) % 360
    lighter = np.where((hue > 22) & (hue < 50), 14.0 * (2 * _ramp(L, 45.0, 65.0) - 1), 0.0)
    hue = hue + lighter  # no display red is lighter than L = 53: a lighter one is coral, which people call orange
    out = np.zeros((len(lab), len(COLOR_NAMES)), np.float32)
    index = {name: i for i, name in enumerate(COLOR_NAMES)}

    pale_free = 5.0 * _ramp(L, 60.0, 85.0)
    colorful = _ramp(chroma - pale_free, 9.0, 20.0) * _ramp(L + 0.5 * chroma, 8.0, 24.0)
    for name, low, high in _HUES:
        middle, half = (low + high) / 2, (high - low) / 2
        off = np.abs((hue - middle + 180) % 360 - 180) - half
        out[:, index[name]] = colorful * np.clip(0.5 - off / (2 * _HUE_SOFT_DEG), 0, 1)

    dull = _ramp(-L, -60.0, -44.0) * _ramp(-chroma, -60.0, -42.0)
    for name, share in (("red", 0.4), ("orange", 1.0), ("yellow", 0.5)):
        moved = out[:, index[name]] * dull * share
        out[:, index[name]] -= moved
        out[:, index["brown"]] += moved
    pale = _ramp(L, 58.0, 70.0) * _ramp(-chroma, -55.0, -40.0) * (hue < 30)
    moved = out[:, index["red"]] * pale
    out[:, index["red"]] -= moved
    out[:, index["pink"]] += moved

    grey = 1 - colorful
    black, white = _ramp(-L, -38.0, -20.0), _ramp(L, 62.0, 80.0)
    out[:, index["black"]] += grey * black
    out[:, index["white"]] += grey * white
    out[:, index["grey"]] += grey * (1 - black - white)
    return out / np.maximum(out.sum(axis=1, keepdims=True), 1e-6)


def name_colors(lab: Array) -> tuple[tuple[str, float], ...]:
    """Return the colour names of a thing's pixels (N, 3) with their shares, largest first; below 3 % is left out."""
    shares = color_memberships(_without_shading(lab)).mean(axis=0)
    order = np.argsort(-shares, kind="stable")
    return tuple((COLOR_NAMES[i], round(float(shares[i]), 4)) for i in order if shares[i] >= 0.03)


def _without_shading(lab: Array) -> Array:
    """Brighten pixels that are likely the same paint turned away from the light.

    Shading scales linear light, which scales (L + 16, a, b) by its cube root. Pixels are brightened half-way towards
    the brightest of their own hue, and only those that are not much darker.
    """
    out = lab.copy()
    chroma = np.hypot(lab[:, 1], lab[:, 2])
    hue = np.degrees(np.arctan2(lab[:, 2], lab[:, 1])) % 360
    paint = np.where(chroma < 15, -1, (hue // 30).astype(int))
    for kind in np.unique(paint):
        own = paint == kind
        if own.sum() < 10:
            continue
        L = lab[own, 0]
        bright = float(np.percentile(L, 85))
        factor = np.sqrt((bright + 16) / np.maximum(L + 16, 1))
        factor = np.where((0.5 * bright < L) & (bright > L), factor, 1.0)
        out[own, 0] = (L + 16) * factor - 16
        out[own, 1:] *= factor[:, None]
    return out
