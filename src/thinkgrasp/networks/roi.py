"""Features of a box at a fixed size: RoIAlign (half-pixel, adaptive sampling) over the levels of a pyramid.

The operation is separable: a bin's mean over its samples is a weighted sum over the few rows and columns it touches,
so each bin is one bag of map cells with weights, and only cells inside the box are read.

References:
    [He2017] Mask R-CNN, section 3; detectron2's ROIAlignV2 and ROIPooler, in behaviour; checked against
    ../shared/vlpart/golden_ops.npz.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

CANONICAL_SIZE_PX = 224
CANONICAL_LEVEL = 4
"""A box of CANONICAL_SIZE_PX squared is pooled from this level."""
MAX_ENTRIES = 1 << 20
"""So many cells are listed at a time; it bounds the memory."""


def assign_levels(boxes: Tensor, first: int, last: int) -> Tensor:
    """Return the pyramid level (N,) int64 of each box by its size, limited to first..last."""
    sizes = torch.sqrt((boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1]))
    return torch.floor(CANONICAL_LEVEL + torch.log2(sizes / CANONICAL_SIZE_PX + 1e-8)).clamp(first, last).long()


def pool(maps: Sequence[Tensor], boxes: Tensor, levels: Tensor, *, first: int, size: int) -> Tensor:
    """Return the features (N, C, size, size) of boxes, each from its level.

    Args:
        maps: (1, C, H, W), of levels first, first + 1, ..., where level i has stride 2^i.
        boxes: (N, 4) [px of the image].
        levels: (N,) int64.
        first: Level of the first map.
        size: Bins per side.
    """
    pooled = maps[0].new_zeros(len(boxes), size * size, maps[0].shape[1])
    for level, features in enumerate(maps, start=first):
        rows = (levels == level).nonzero()[:, 0]
        _pool_into(pooled, rows, features, boxes[rows], 1.0 / 2**level, size, None)
    return pooled.transpose(1, 2).unflatten(2, (size, size)).contiguous()


def roi_align(features: Tensor, boxes: Tensor, *, scale: float, size: int, sampling_ratio: int | None = None) -> Tensor:
    """Return the features (N, C, size, size) of boxes (N, 4) on one map (1, C, H, W).

    Args:
        features: The map.
        boxes: [px of the image]; a box without area gives zeros.
        scale: Map cells per image pixel.
        size: Bins per side.
        sampling_ratio: Samples per bin and axis; None = as many as the bin is long in cells, rounded up.
    """
    pooled = features.new_zeros(len(boxes), size * size, features.shape[1])
    _pool_into(pooled, torch.arange(len(boxes), device=boxes.device), features, boxes, scale, size, sampling_ratio)
    return pooled.transpose(1, 2).unflatten(2, (size, size)).contiguous()


def _pool_into(
    pooled: Tensor, into: Tensor, features: Tensor, boxes: Tensor, scale: float, size: int, sampling_ratio: int | None
) -> None:
    """Write the features of boxes (M, 4) to the rows `into` (M,) of zeros (N, size * size, C)."""
    _, channels, height, width = features.shape
    cells = features[0].permute(1, 2, 0).reshape(height * width, channels)
    scaled = boxes.float() * scale - 0.5
    lengths = scaled[:, 2:] - scaled[:, :2]
    if sampling_ratio is None:
        samples = torch.ceil(lengths / size).long().clamp_(min=0)
    else:
        samples = torch.full_like(lengths, sampling_ratio, dtype=torch.int64)
    blocks = _blocks_alike(samples, size) if samples.device.type == "cpu" else _blocks_of_any(samples, size)
    for rows in blocks:
        columns, weights_x = _taps(scaled[rows, 0], lengths[rows, 0], samples[rows, 0], size, width)
        lines, weights_y = _taps(scaled[rows, 1], lengths[rows, 1], samples[rows, 1], size, height)
        bags = lines[:, :, None, :, None] * width + columns[:, None, :, None, :]
        weights = weights_y[:, :, None, :, None] * weights_x[:, None, :, None, :]
        bags = bags.reshape(len(rows) * size * size, -1)
        weights = weights.reshape(bags.shape).to(cells.dtype)
        sums = functional.embedding_bag(bags, cells, mode="sum", per_sample_weights=weights)
        pooled.index_copy_(0, into[rows], sums.view(len(rows), size * size, channels))


def _blocks_alike(samples: Tensor, size: int) -> list[Tensor]:
    """Part the boxes that have samples (N, 2) into blocks with the same ones: no box costs more for another."""
    return [
        rows
        for gx, gy in torch.unique(samples, dim=0).tolist()
        if gx and gy
        for rows in _split(((samples[:, 0] == gx) & (samples[:, 1] == gy)).nonzero()[:, 0], gx, gy, size)
    ]


def _blocks_of_any(samples: Tensor, size: int) -> list[Tensor]:
    """Part them into few blocks, each box padded to the largest one: on a GPU, what is launched costs most."""
    rows = (samples > 0).all(dim=1).nonzero()[:, 0]
    if len(rows) == 0:
        return []
    gx, gy = samples[rows].amax(dim=0).tolist()
    return _split(rows, gx, gy, size, room=16)


def _split(rows: Tensor, gx: int, gy: int, size: int, room: int = 1) -> list[Tensor]:
    return list(rows.split(max(1, room * MAX_ENTRIES // (size * size * (gx + 1) * (gy + 1)))))


def _taps(start: Tensor, length: Tensor, samples: Tensor, size: int, extent: int) -> tuple[Tensor, Tensor]:
    """Return the cells (N, size, T) that the bins of one axis read, and their weights in the bins' means.

    A sample between two cells reads both; within one cell of the border it reads the border, further out nothing.
    """
    steps = torch.arange(int(samples.max()), device=start.device, dtype=torch.float32)
    bins = torch.arange(size, device=start.device, dtype=torch.float32)
    per_bin = samples.float()[:, None, None]
    places = bins[:, None] + (steps + 0.5) / per_bin
    at = start[:, None, None] + (length / size)[:, None, None] * places
    counts = ((at >= -1) & (at <= extent) & (steps < per_bin)).float() / per_bin
    at = at.clamp(min=0, max=extent - 1)
    low = at.long()
    beyond = (at - low) * counts
    first = low[..., :1]
    offsets = low - first
    taps = int(offsets.max()) + 2
    weights = at.new_zeros(*low.shape[:2], taps)
    weights.scatter_add_(2, offsets, counts - beyond).scatter_add_(2, offsets + 1, beyond)
    cells = (first + torch.arange(taps, device=start.device)).clamp_(max=extent - 1)
    return cells, weights
