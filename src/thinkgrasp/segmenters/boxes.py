"""Boxes and masks in the image, pure numpy: clipping, overlap, suppression, and the segment of a mask.

Boxes are (N, 4) float32 x0, y0, x1, y1 [px], continuous: the image spans 0..width and 0..height.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.types import Array, Mask, Segment

MIN_SIDE_PX = 1.0
"""A box that is thinner than this inside the image shows nothing."""


def clip_boxes(boxes: NDArray[np.floating], image_hw: tuple[int, int]) -> Array:
    """Return boxes cut to the image; those outside get no area."""
    h, w = image_hw
    return np.clip(boxes, 0, np.array([w, h, w, h], np.float32)).astype(np.float32)


def has_area(boxes: Array) -> NDArray[np.bool_]:
    """Return (N,) True for boxes with both sides of at least MIN_SIDE_PX; False where a number is missing."""
    return (boxes[:, 2] - boxes[:, 0] >= MIN_SIDE_PX) & (boxes[:, 3] - boxes[:, 1] >= MIN_SIDE_PX)


def box_iou(a: Array, b: Array) -> NDArray[np.float64]:
    """Return the intersection over union (N, M) of boxes (N, 4) with boxes (M, 4); 0 where there is no area."""
    p, q = np.asarray(a, np.float64), np.asarray(b, np.float64)
    low, high = np.maximum(p[:, None, :2], q[None, :, :2]), np.minimum(p[:, None, 2:], q[None, :, 2:])
    both = np.prod(np.clip(high - low, 0, None), axis=2)
    areas = [np.prod(np.clip(boxes[:, 2:] - boxes[:, :2], 0, None), axis=1) for boxes in (p, q)]
    either = areas[0][:, None] + areas[1][None] - both
    return np.divide(both, either, out=np.zeros_like(both), where=either > 0)


def suppress(boxes: Array, scores: Array, max_iou: float) -> NDArray[np.intp]:
    """Return the indices of boxes to keep, best first: none overlaps a better one by more than `max_iou`.

    Equal scores keep their order.
    """
    order = np.argsort(-scores, kind="stable")
    overlaps = box_iou(boxes[order], boxes[order]) > max_iou
    alive = np.ones(len(order), bool)
    for i in range(len(order)):
        if alive[i]:
            alive[i + 1 :] &= ~overlaps[i, i + 1 :]
    return order[alive]


def mask_box(mask: Mask) -> tuple[int, int, int, int]:
    """Return the half-open box of a mask that is not empty."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


def cut_by_border(box_xyxy: tuple[int, int, int, int], image_hw: tuple[int, int]) -> bool:
    """Whether a half-open box reaches the image's border."""
    x0, y0, x1, y1 = box_xyxy
    return x0 <= 0 or y0 <= 0 or x1 >= image_hw[1] or y1 >= image_hw[0]


def segment_of(mask: Mask, label: str, score: float, mark: int | None = None) -> Segment:
    """Return the segment of a mask that is not empty."""
    box = mask_box(mask)
    return Segment(label, score, mask, box, cut_by_border(box, (mask.shape[0], mask.shape[1])), mark)


def mask_iou(a: Mask, b: Mask) -> float:
    """Return the intersection of two masks over their union; 0 where both are empty."""
    return float(np.count_nonzero(a & b) / max(np.count_nonzero(a | b), 1))
