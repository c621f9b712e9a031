"""Feature pyramid: maps of one width at strides 4, 8, 16, 32, and a fifth by taking every second cell.

References:
    [Lin2017] Feature Pyramid Networks, in detectron2's form; checked against ../shared/vlpart.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

from torch import Tensor, nn

FIRST_LEVEL = 2
"""The first map is p2: stride 2^2."""


class FeaturePyramid(nn.Module):
    """A backbone with lateral and output convolutions; the names of its parts are the checkpoint's."""

    def __init__(self, bottom_up: nn.Module, widths: Sequence[int], channels: int) -> None:
        super().__init__()
        self.bottom_up = bottom_up
        self.levels = tuple(range(FIRST_LEVEL, FIRST_LEVEL + len(widths)))
        for level, width in zip(self.levels, widths, strict=True):
            self.add_module(f"fpn_lateral{level}", nn.Conv2d(width, channels, 1))
            self.add_module(f"fpn_output{level}", nn.Conv2d(channels, channels, 3, padding=1))

    def forward(self, image: Tensor) -> list[Tensor]:
        """Map (1, 3, H, W), sides multiples of 32, to p2..p6, each (1, C, H / 2^i, W / 2^i)."""
        return self.merge(self.bottom_up(image))

    def merge(self, maps: Sequence[Tensor]) -> list[Tensor]:
        """Map the backbone's stages, finest first, to p2..p6."""
        merged: Tensor | None = None
        pyramid: list[Tensor] = []
        for level, stage in zip(reversed(self.levels), reversed(maps), strict=True):
            lateral = cast(Tensor, self.get_submodule(f"fpn_lateral{level}")(stage))
            if merged is not None:  # each cell of the coarser map is added to four
                lateral.unflatten(3, (-1, 2)).unflatten(2, (-1, 2)).add_(merged[:, :, :, None, :, None])
            merged = lateral
            pyramid.insert(0, self.get_submodule(f"fpn_output{level}")(merged))
        return [*pyramid, pyramid[-1][:, :, ::2, ::2]]
