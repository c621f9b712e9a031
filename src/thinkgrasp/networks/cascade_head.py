"""Cascade heads: three times pool, describe and move the boxes; what a box shows is compared with text only afterwards.

Boxes move alike for all classes, so nothing here depends on the text: a second text costs one product per stage.

References:
    [Cai2018] Cascade R-CNN, and VLPart's text classifier; checked against ../shared/vlpart.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from thinkgrasp.networks import boxes as bx
from thinkgrasp.networks import roi

TEMPERATURE = 50.0
"""Factor of the cosine between a box and a text."""
BOX_WEIGHTS = ((10.0, 10.0, 5.0, 5.0), (20.0, 20.0, 10.0, 10.0), (30.0, 30.0, 15.0, 15.0))
"""What the deltas of each stage are divided by."""
BINS = 7
FIRST_LEVEL, LAST_LEVEL = 2, 5
"""Boxes are pooled from p2..p5."""


class BoxHead(nn.Module):
    """Describe a pooled box by one vector."""

    def __init__(self, channels: int, width: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(channels * BINS**2, width)
        self.fc2 = nn.Linear(width, width)

    def forward(self, pooled: Tensor) -> Tensor:
        """Map (N, C, 7, 7) to (N, width)."""
        return functional.relu(self.fc2(functional.relu(self.fc1(pooled.flatten(1)), inplace=True)), inplace=True)


class TextClassifier(nn.Module):
    """Compare a box with texts."""

    def __init__(self, width: int, text_width: int) -> None:
        super().__init__()
        self.linear = nn.Linear(width, text_width)

    def forward(self, described: Tensor) -> Tensor:
        """Map (N, width) to vectors (N, text_width) of length TEMPERATURE, to be multiplied by unit texts."""
        return TEMPERATURE * functional.normalize(self.linear(described), dim=1, eps=1e-12)


class BoxPredictor(nn.Module):
    """Classify and move a described box."""

    def __init__(self, width: int, text_width: int) -> None:
        super().__init__()
        self.cls_score = TextClassifier(width, text_width)
        self.bbox_pred = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, 4))


class Stage(NamedTuple):
    """What one stage saw and answered, for N boxes."""

    boxes_in: Tensor
    """(N, 4) float32."""
    levels: Tensor
    """(N,) int64 pyramid level."""
    pooled: Tensor
    """(N, C, 7, 7)."""
    described: Tensor
    """(N, width)."""
    deltas: Tensor
    """(N, 4)."""
    queries: Tensor
    """(N, text_width) float32 of length TEMPERATURE."""
    boxes_out: Tensor
    """(N, 4) float32, not clipped."""


class CascadeHead(nn.Module):
    """Three stages, each with its own weights; the names of its parts are the checkpoint's."""

    def __init__(self, channels: int, width: int, text_width: int) -> None:
        super().__init__()
        self.box_head = nn.ModuleList(BoxHead(channels, width) for _ in BOX_WEIGHTS)
        self.box_predictor = nn.ModuleList(BoxPredictor(width, text_width) for _ in BOX_WEIGHTS)

    def stage(self, number: int, maps: Sequence[Tensor], boxes: Tensor) -> Stage:
        """Run one stage on p2..p5 and boxes (N, 4) inside the image."""
        predictor = cast(BoxPredictor, self.box_predictor[number])
        levels = roi.assign_levels(boxes, FIRST_LEVEL, LAST_LEVEL)
        pooled = roi.pool(maps, boxes, levels, first=FIRST_LEVEL, size=BINS)
        described = self.box_head[number](pooled)
        deltas = predictor.bbox_pred(described).float()
        queries = predictor.cls_score(described).float()
        moved = bx.decode(deltas, boxes, BOX_WEIGHTS[number])
        return Stage(boxes, levels, pooled, described, deltas, queries, moved)

    def forward(self, maps: Sequence[Tensor], boxes: Tensor, size_hw: tuple[int, int]) -> tuple[Tensor, Tensor]:
        """Return the boxes after all stages (N, 4), not clipped, and the stages' queries (3, N, text_width).

        Boxes are clipped between stages and never dropped, so that rows stay aligned.
        """
        queries: list[Tensor] = []
        for number in range(len(BOX_WEIGHTS)):
            stage = self.stage(number, maps, bx.clip(boxes, size_hw))
            boxes = stage.boxes_out
            queries.append(stage.queries)
        return boxes, torch.stack(queries)
