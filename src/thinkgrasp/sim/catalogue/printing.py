"""Prints on things: labels, speckles, seams, buttons, as small RGB images drawn from a generator."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from PIL import Image, ImageDraw

RGB = tuple[int, int, int]
Picture = NDArray[np.uint8]
SIZE = 96


def label(base: RGB, accent: RGB, ink: RGB, rng: Generator, *, repeats: int = 1, height: int = SIZE) -> Picture:
    """A front: a panel in the accent colour with a title in words-like blocks, lines of small print, a round mark.

    The base colour keeps about two thirds of the area. `repeats` copies it around a can or bottle.
    """
    image, draw = _sheet(base, SIZE, height)
    h = height / 100
    top = float(rng.uniform(16, 24))
    draw.rounded_rectangle((10, top * h, SIZE - 10, (top + 26) * h), 6, fill=accent)
    _words(draw, 18, SIZE - 18, (top + 7) * h, 12 * h, ink if _far(ink, accent) else base, rng)
    for row in range(3):
        _words(draw, 14, SIZE - 34, (60 + 9 * row) * h, 3 * h, ink, rng)
    draw.ellipse((SIZE - 30, 60 * h, SIZE - 10, 60 * h + 20), fill=accent)
    return np.tile(np.asarray(image), (1, repeats, 1))


def bands(colors: tuple[tuple[float, RGB], ...], *, height: int = SIZE) -> Picture:
    """Level bands from the top: (share of the height, colour)."""
    edges = np.cumsum([share for share, _ in colors])
    rows = np.searchsorted(edges / edges[-1], (np.arange(height) + 0.5) / height)
    return np.repeat(np.array([c for _, c in colors], np.uint8)[rows][:, None], 8, axis=1)


def blush(base: RGB, flush: RGB, share: float = 0.35) -> Picture:
    """One side flushed with another colour, as ripe fruit."""
    around = np.linspace(-np.pi, np.pi, SIZE, endpoint=False)
    weight = np.clip((np.cos(around) - np.cos(np.pi * share)) * 1.5, 0, 1)[None, :, None]
    row = (1 - weight) * np.array(base) + weight * np.array(flush)
    return np.repeat(row.round().astype(np.uint8), 8, axis=0)


def speckles(base: RGB, spots: RGB, count: int, rng: Generator, size: float = 1.5) -> Picture:
    """Small round spots, none near the upper and lower edge, where a sphere's picture is pinched."""
    image, draw = _sheet(base, 2 * SIZE, SIZE)
    for _ in range(count):
        x, y = rng.uniform(0, 2 * SIZE), SIZE * rng.uniform(0.12, 0.88)
        r = size * rng.uniform(0.7, 1.3)
        draw.ellipse((x - r, y - r, x + r, y + r), fill=spots)
    return np.asarray(image)


def seam(base: RGB, line: RGB, width: int = 4) -> Picture:
    """The curve on a tennis ball, in longitude and latitude."""
    image, draw = _sheet(base, 2 * SIZE, SIZE)
    t = np.linspace(0, 2 * np.pi, 200)
    x = 2 * SIZE * t / (2 * np.pi)
    y = SIZE * (0.5 + 0.25 * np.sin(2 * t))
    draw.line(list(zip(x.tolist(), y.tolist(), strict=True)), fill=line, width=width)
    return np.asarray(image)


def squares(color: RGB, line: RGB, count: int = 3) -> Picture:
    """A grid of squares with dark lines between."""
    image, draw = _sheet(line, SIZE, SIZE)
    step = SIZE / count
    for i in range(count):
        for j in range(count):
            draw.rounded_rectangle((i * step + 2, j * step + 2, (i + 1) * step - 3, (j + 1) * step - 3), 3, fill=color)
    return np.asarray(image)


def panels(base: RGB, spot: RGB, rows: int = 3, columns: int = 4) -> Picture:
    """Round panels in rows, every second row shifted: a football, a golf ball."""
    image, draw = _sheet(base, 2 * SIZE, SIZE)
    r = SIZE / rows / 3.2
    for j in range(rows):
        for i in range(columns + 1):
            x, y = 2 * SIZE * (i + 0.5 * (j % 2)) / columns, SIZE * (j + 0.5) / rows
            draw.regular_polygon((x, y, r), 5, fill=spot)
    return np.asarray(image)


def buttons(base: RGB, key: RGB, accent: RGB, rows: int, columns: int) -> Picture:
    """Rows of keys seen from above, the first one in the accent colour; rows run along the picture's width."""
    image, draw = _sheet(base, 2 * SIZE, SIZE)
    for i in range(rows):
        for j in range(columns):
            x, y = 2 * SIZE * (i + 0.5) / rows, SIZE * (j + 0.5) / columns
            rx, ry = SIZE / rows * 0.6, SIZE / columns * 0.3
            draw.ellipse((x - rx, y - ry, x + rx, y + ry), fill=accent if i == j == 0 else key)
    return np.asarray(image)


def stripes(colors: tuple[RGB, ...], repeats: int = 1) -> Picture:
    """Upright stripes of equal width."""
    return np.repeat(np.array(colors * repeats, np.uint8)[None], 8, axis=0).repeat(8, axis=1)


def _sheet(base: RGB, width: int, height: int) -> tuple[Image.Image, ImageDraw.ImageDraw]:
    image = Image.new("RGB", (width, height), base)
    return image, ImageDraw.Draw(image)


def _words(
    draw: ImageDraw.ImageDraw, left: float, right: float, top: float, height: float, ink: RGB, rng: Generator
) -> None:
    x = left
    while x < right - 6:
        width = min(float(rng.uniform(6, 20)), right - x)
        draw.rectangle((x, top, x + width, top + height), fill=ink)
        x += width + 4


def _far(a: RGB, b: RGB) -> bool:
    return sum(abs(p - q) for p, q in zip(a, b, strict=True)) > 150
