"""Boxes of detectors: (N, 4) float32 x0, y0, x1, y1 in pixels, continuous coordinates (width = x1 - x0).

References:
    [He2017] Mask R-CNN and detectron2's box operations, in behaviour; checked against ../shared/vlpart/golden_ops.npz.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

MAX_LOG_SCALE = math.log(1000 / 16)
"""A decoded side is at most this factor (as a logarithm) of its reference box's."""
NMS_BLOCK = 256
"""So many boxes are compared at a time."""


def decode(deltas: Tensor, boxes: Tensor, weights: Sequence[float]) -> Tensor:
    """Apply (N, 4) deltas dx, dy, dw, dh, divided by `weights`, to reference boxes (N, 4)."""
    w, h = boxes[:, 2] - boxes[:, 0], boxes[:, 3] - boxes[:, 1]
    cx, cy = boxes[:, 0] + 0.5 * w, boxes[:, 1] + 0.5 * h
    cx = deltas[:, 0] / weights[0] * w + cx
    cy = deltas[:, 1] / weights[1] * h + cy
    w = torch.exp((deltas[:, 2] / weights[2]).clamp(max=MAX_LOG_SCALE)) * w
    h = torch.exp((deltas[:, 3] / weights[3]).clamp(max=MAX_LOG_SCALE)) * h
    return torch.stack([cx - 0.5 * w, cy - 0.5 * h, cx + 0.5 * w, cy + 0.5 * h], dim=1)


def clip(boxes: Tensor, size_hw: tuple[int, int]) -> Tensor:
    """Return boxes limited to 0..width and 0..height."""
    height, width = size_hw
    limit = boxes.new_tensor([width, height, width, height])
    return torch.minimum(boxes.clamp(min=0), limit)


def has_area(boxes: Tensor) -> Tensor:
    """Return (N,) True where both sides are longer than zero."""
    return (boxes[:, 2] > boxes[:, 0]) & (boxes[:, 3] > boxes[:, 1])


def iou(a: Tensor, b: Tensor) -> Tensor:
    """Return intersection over union (A, B); NaN for two boxes without area."""
    low = torch.maximum(a[:, None, :2], b[None, :, :2])
    high = torch.minimum(a[:, None, 2:], b[None, :, 2:])
    sides = (high - low).clamp_(min=0)
    shared = sides[..., 0] * sides[..., 1]
    areas_a = (a[:, 2] - a[:, 0]) * (a[:, 3] - a[:, 1])
    areas_b = (b[:, 2] - b[:, 0]) * (b[:, 3] - b[:, 1])
    return shared / (areas_a[:, None] + areas_b[None] - shared)


def nms(boxes: Tensor, scores: Tensor, threshold: float, *, limit: int | None = None) -> Tensor:
    """Return the indices of boxes that no better kept box overlaps by more than `threshold`, best first.

    Equal scores keep their order. With `limit`, the first so many that are kept.
    """
    order = torch.sort(scores, descending=True, stable=True).indices
    ordered = boxes[order]
    limit = len(boxes) if limit is None else limit
    kept = order.new_empty(0)
    for start in range(0, len(boxes), NMS_BLOCK):
        if len(kept) >= limit:
            break
        block = ordered[start : start + NMS_BLOCK]
        free = ~(iou(block, ordered[kept]) > threshold).any(dim=1)
        free = _greedy(free, iou(block, block) > threshold)
        kept = torch.cat([kept, free.nonzero()[:, 0] + start])
    return order[kept[:limit]]


def grouped_nms(boxes: Tensor, scores: Tensor, groups: Tensor, threshold: float, *, limit: int | None = None) -> Tensor:
    """Return the survivors of `nms` within each group (N,), all groups together best first."""
    kept = [
        members[nms(boxes[members], scores[members], threshold, limit=limit)]
        for members in ((groups == group).nonzero()[:, 0] for group in torch.unique(groups))
    ]
    together = torch.cat(kept).sort().values if kept else groups.new_empty(0, dtype=torch.int64)
    order = torch.sort(scores[together], descending=True, stable=True).indices
    return together[order[:limit]]


def _greedy(free: Tensor, overlaps: Tensor) -> Tensor:
    """Return which of the free boxes (B,) stay, in order, when each removes the later ones it overlaps (B, B)."""
    alive, removes = free.cpu().numpy().copy(), overlaps.cpu().numpy()
    removes = np.triu(removes, k=1)
    for i in np.flatnonzero(removes.any(axis=1)):
        if alive[i]:
            alive &= ~removes[i]
    return torch.from_numpy(alive).to(free.device)
