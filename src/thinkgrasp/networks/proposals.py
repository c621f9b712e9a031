"""Region proposals: anchors, the head that rates and moves them, and which of them are kept.

References:
    [Ren2015] Faster R-CNN, section 3.1, in detectron2's form; checked against ../shared/vlpart.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from thinkgrasp.networks import boxes as bx

RATIOS = (0.5, 1.0, 2.0)
"""Height over width of the anchors at one place, in this order."""


class Proposals(NamedTuple):
    """Boxes (N, 4) float32 [px of the network's image] and their raw objectness logits (N,), best first."""

    boxes: Tensor
    logits: Tensor


def cell_anchors(size: float, ratios: Sequence[float] = RATIOS) -> Tensor:
    """Return the anchors (R, 4) of area size^2 around the origin."""
    sides = [(math.sqrt(size * size / ratio), math.sqrt(size * size / ratio) * ratio) for ratio in ratios]
    return torch.tensor([(-w / 2, -h / 2, w / 2, h / 2) for w, h in sides], dtype=torch.float64).float()


def grid_anchors(size_hw: tuple[int, int], stride: int, size: float, ratios: Sequence[float] = RATIOS) -> Tensor:
    """Return the anchors (H * W * R, 4) of a map, by row, column, ratio; the first cell's centre is the origin."""
    height, width = size_hw
    y, x = torch.meshgrid(torch.arange(height) * stride, torch.arange(width) * stride, indexing="ij")
    shifts = torch.stack([x, y, x, y], dim=-1).reshape(-1, 1, 4).float()
    return (shifts + cell_anchors(size, ratios)).reshape(-1, 4)


class RPNHead(nn.Module):
    """Rate and move every anchor of a map; one head for all levels."""

    def __init__(self, channels: int, anchors: int = len(RATIOS)) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, channels, 3, padding=1)
        self.objectness_logits = nn.Conv2d(channels, anchors, 1)
        self.anchor_deltas = nn.Conv2d(channels, 4 * anchors, 1)

    def forward(self, level: Tensor) -> tuple[Tensor, Tensor]:
        """Map (1, C, H, W) to logits (1, R, H, W) and deltas (1, 4R, H, W), channels ratio by ratio."""
        hidden = functional.relu(self.conv(level), inplace=True)
        return self.objectness_logits(hidden), self.anchor_deltas(hidden)


def best_of_level(logits: Tensor, deltas: Tensor, anchors: Tensor, count: int) -> Proposals:
    """Decode the `count` best of a level's anchors.

    Args:
        logits: (1, R, H, W).
        deltas: (1, 4R, H, W).
        anchors: (H * W * R, 4).
        count: At most so many.
    """
    flat = logits[0].permute(1, 2, 0).reshape(-1).float()
    best = torch.sort(flat, descending=True, stable=True).indices[:count]
    moves = deltas[0].permute(1, 2, 0).reshape(-1, 4)[best].float()
    return Proposals(bx.decode(moves, anchors[best], (1, 1, 1, 1)), flat[best])


def select(levels: Sequence[Proposals], size_hw: tuple[int, int], *, threshold: float, limit: int) -> Proposals:
    """Clip the levels' proposals to the image, drop overlaps within each level, and keep the best of all.

    Boxes that are not finite or have no area after clipping are dropped.
    """
    boxes = torch.cat([level.boxes for level in levels])
    logits = torch.cat([level.logits for level in levels])
    of_level = torch.cat([torch.full_like(level.logits, i, dtype=torch.int64) for i, level in enumerate(levels)])
    finite = torch.isfinite(boxes).all(dim=1) & torch.isfinite(logits)
    boxes = bx.clip(boxes, size_hw)
    keep = (finite & bx.has_area(boxes)).nonzero()[:, 0]
    boxes, logits, of_level = boxes[keep], logits[keep], of_level[keep]
    best = bx.grouped_nms(boxes, logits, of_level, threshold, limit=limit)
    return Proposals(boxes[best], logits[best])
