"""Draw numbered marks on an image, for a model that answers with their numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy import ndimage

from thinkgrasp.types import Mask, Proposal

RGB = tuple[int, int, int]

COLORS: tuple[RGB, ...] = ((255, 221, 51), (64, 224, 255), (255, 128, 224), (128, 255, 128), (255, 160, 96))
"""Outlines, in turn; each is bright, so that it shows on dark things, and has a dark line beside it for bright ones."""
FONT_SHARE = 0.022
MIN_FONT_PX = 11
PADDING_PX = 2


def resized(image: NDArray[np.uint8], size_wh: tuple[int, int]) -> NDArray[np.uint8]:
    """Return an RGB image (H, W, 3) in another size (w, h); the same array where it has that size already."""
    if (image.shape[1], image.shape[0]) == size_wh:
        return image
    return np.asarray(Image.fromarray(image).resize(size_wh, Image.Resampling.BILINEAR, reducing_gap=2.0))


def draw_marks(image: NDArray[np.uint8], proposals: Sequence[Proposal], size_wh: tuple[int, int]) -> NDArray[np.uint8]:
    """Outline each proposal and write its mark inside it, white on a black plate with a white rim.

    Args:
        image: (H, W, 3) RGB of the frame that the proposals belong to; it is not changed.
        proposals: What to mark; smaller things choose their mark's place first.
        size_wh: Size (w, h) of the picture to return.

    Returns:
        (h, w, 3) RGB.
    """
    picture = resized(image, size_wh).copy()
    masks = {p.mark: _Window.of(p, size_wh) for p in proposals}
    for p in proposals:
        masks[p.mark].outline(picture, COLORS[(p.mark - 1) % len(COLORS)])
    font = _font(max(MIN_FONT_PX, round(FONT_SHARE * size_wh[0])))
    canvas = Image.fromarray(picture)
    draw = ImageDraw.Draw(canvas)
    plates: list[tuple[int, int, int, int]] = []
    for p in sorted(proposals, key=lambda p: (int(np.count_nonzero(p.mask)), p.mark)):
        left, top, right, bottom = (math.ceil(side) for side in font.getbbox(str(p.mark)))
        w, h = right - left + 2 * PADDING_PX + 2, bottom - top + 2 * PADDING_PX + 2
        x, y = masks[p.mark].place(w, h, plates)
        x, y = min(max(x - w // 2, 0), size_wh[0] - w), min(max(y - h // 2, 0), size_wh[1] - h)
        plates.append((x, y, x + w, y + h))
        draw.rectangle((x, y, x + w - 1, y + h - 1), fill=(0, 0, 0), outline=(255, 255, 255))
        draw.text((x + PADDING_PX + 1 - left, y + PADDING_PX + 1 - top), str(p.mark), (255, 255, 255), font)
    return np.asarray(canvas)


@lru_cache(maxsize=8)
def _font(size_px: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size=size_px)


class _Window:
    """A mask (h, w) in the picture's size, cut to its surroundings; (x, y) is the window's corner."""

    def __init__(self, x: int, y: int, mask: Mask) -> None:
        self.x = x
        self.y = y
        self.mask = mask

    @classmethod
    def of(cls, proposal: Proposal, size_wh: tuple[int, int]) -> _Window:
        """Scale a proposal's mask to the picture, with a margin of two pixels inside it."""
        x0, y0, x1, y1 = proposal.box_xyxy
        u, x = _sampled(x0, x1, proposal.mask.shape[1], size_wh[0])
        v, y = _sampled(y0, y1, proposal.mask.shape[0], size_wh[1])
        return cls(x, y, proposal.mask[np.ix_(v, u)])

    def outline(self, picture: NDArray[np.uint8], color: RGB) -> None:
        """Draw a bright line along the inside of the mask's edge and a dark one along its outside, in place."""
        h, w = self.mask.shape
        region = picture[self.y : self.y + h, self.x : self.x + w]
        region[_grown(self.mask) & ~self.mask] = (0, 0, 0)
        region[self.mask & _grown(~self.mask)] = color

    def place(self, w: int, h: int, plates: Sequence[tuple[int, int, int, int]]) -> tuple[int, int]:
        """Return the pixel (x, y) of the mask farthest from its edge where a plate of (w, h) covers no other plate."""
        if not self.mask.any():
            return self.x, self.y
        depth = np.asarray(ndimage.distance_transform_cdt(np.pad(self.mask, 1), "chessboard"))[1:-1, 1:-1]
        free = np.where(self.mask, depth, 0)
        for x0, y0, x1, y1 in plates:
            rows = slice(max(y0 - h // 2 - 1 - self.y, 0), max(y1 + h // 2 + 2 - self.y, 0))
            columns = slice(max(x0 - w // 2 - 1 - self.x, 0), max(x1 + w // 2 + 2 - self.x, 0))
            free[rows, columns] = 0
        best = free if free.any() else depth
        row, column = np.unravel_index(int(np.argmax(best)), best.shape)
        return self.x + int(column), self.y + int(row)


def _sampled(start: int, stop: int, frame_px: int, picture_px: int) -> tuple[NDArray[np.intp], int]:
    """Return the frame's pixel for each of the picture's pixels around a range, and the first of these."""
    scale = picture_px / frame_px
    first = max(int(start * scale) - 2, 0)
    last = min(math.ceil(stop * scale) + 2, picture_px)
    pixels = ((np.arange(first, last) + 0.5) / scale).astype(np.intp)
    return np.minimum(pixels, frame_px - 1), first


def _grown(mask: Mask) -> Mask:
    """Return a mask grown by one pixel to the four sides."""
    grown = mask.copy()
    grown[1:] |= mask[:-1]
    grown[:-1] |= mask[1:]
    grown[:, 1:] |= mask[:, :-1]
    grown[:, :-1] |= mask[:, 1:]
    return grown
