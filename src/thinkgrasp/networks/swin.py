"""Swin Transformer: attention within 7 x 7 windows that shift by 3 in every second block.

Exactness notes, all from the reference's behaviour: the map is padded after the norm, so padding takes part in
attention as keys and values that are the projection's biases; window and shift are never reduced for small maps;
pairs across the shift's seams get -100, not minus infinity.

References:
    [Liu2021] Swin Transformer; checked against ../shared/vlpart (block by block).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

SEAM = -100.0
"""Added to the logits of two tokens that only the cyclic shift has brought together."""
TOKENS_AT_A_TIME = 4096
"""About so many tokens go through a block together: it bounds the memory, and what is in work stays in the cache."""


@dataclass(frozen=True)
class SwinConfig:
    """Sizes of the transformer; the defaults are Swin-B's."""

    width: int = 128
    depths: tuple[int, ...] = (2, 2, 18, 2)
    heads: tuple[int, ...] = (4, 8, 16, 32)
    window: int = 7
    mlp_ratio: int = 4

    @property
    def widths(self) -> tuple[int, ...]:
        """Channels of each stage."""
        return tuple(self.width * 2**i for i in range(len(self.depths)))


class Windows(NamedTuple):
    """How the tokens of an H x W map are cut into B windows of n = window^2 places and put back."""

    tokens: Tensor
    """(B * n,) int64 token at each place, window by window; any token where the place is padding."""
    padding: Tensor
    """(B, n) bool."""
    places: Tensor
    """(H * W,) int64 place of each token."""
    seams: Tensor | None
    """(B, 1, n, n) 0 or SEAM; None without shift."""


@lru_cache(maxsize=16)
def windows(height: int, width: int, window: int, shift: int, device: torch.device) -> Windows:
    """Cut a map, padded to whole windows and then rolled by `shift` towards its origin."""
    tall, wide = -(-height // window) * window, -(-width // window) * window
    tokens = torch.full((tall, wide), -1)
    tokens[:height, :width] = torch.arange(height * width).view(height, width)
    tokens = _cut(tokens.roll((-shift, -shift), (0, 1)), window)
    padding = tokens < 0
    places = torch.empty(height * width, dtype=torch.int64)
    places[tokens[~padding]] = (~padding).view(-1).nonzero()[:, 0]
    seams = shift_seams(height, width, window, shift)[:, None].to(device) if shift else None
    return Windows(tokens.clamp_(min=0).view(-1).to(device), padding.to(device), places.to(device), seams)


def shift_seams(height: int, width: int, window: int, shift: int) -> Tensor:
    """Return (B, n, n): SEAM for two tokens of a window that are no neighbours before the shift, else 0."""
    tall, wide = -(-height // window) * window, -(-width // window) * window
    regions = torch.zeros(tall, wide)
    bands = (slice(0, -window), slice(-window, -shift), slice(-shift, None))
    for number, (rows, columns) in enumerate((r, c) for r in bands for c in bands):
        regions[rows, columns] = number
    regions = _cut(regions, window)
    return torch.where(regions[:, :, None] == regions[:, None, :], 0.0, SEAM)


def _cut(grid: Tensor, window: int) -> Tensor:
    """Return (B, window^2) of a grid (H, W) whose sides are whole windows; windows and tokens row by row."""
    tall, wide = grid.shape
    cut = grid.view(tall // window, window, wide // window, window)
    return cut.transpose(1, 2).reshape(-1, window * window)


@lru_cache(maxsize=4)
def relative_positions(window: int) -> Tensor:
    """Return (n, n) int64: the row of the bias table for a query token (first axis) and a key token."""
    at = torch.stack(torch.meshgrid(torch.arange(window), torch.arange(window), indexing="ij")).flatten(1)
    rows, columns = at[:, :, None] - at[:, None, :] + window - 1
    return rows * (2 * window - 1) + columns


class WindowAttention(nn.Module):
    """Attention of the tokens of a window to one another, with a bias for their relative position."""

    def __init__(self, width: int, heads: int, window: int) -> None:
        super().__init__()
        self.heads = heads
        self.window = window
        self.relative_position_bias_table = nn.Parameter(torch.zeros((2 * window - 1) ** 2, heads))
        self.qkv = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)

    def forward(self, tokens: Tensor, padding: Tensor, seams: Tensor | None) -> Tensor:
        """Map the normed tokens (B * n, C) of B windows to what each takes from the others, (B * n, C), not projected.

        Args:
            tokens: Window by window.
            padding: (B, n) True for places without token: their vector counts as zero.
            seams: (B, 1, n, n) added to the logits.
        """
        n, width = self.window**2, tokens.shape[1]
        qkv = self.qkv(tokens)
        qkv[padding.view(-1)] = self.qkv.bias
        q, k, v = qkv.view(-1, n, 3, self.heads, width // self.heads).permute(2, 0, 3, 1, 4)
        bias = self.relative_position_bias_table[relative_positions(self.window).view(-1)]
        bias = bias.view(n, n, self.heads).permute(2, 0, 1)[None].contiguous()
        if seams is not None:
            bias = bias + seams.to(bias.dtype)
        mixed = functional.scaled_dot_product_attention(q, k, v, attn_mask=bias)
        return mixed.transpose(1, 2).reshape(-1, width)


class Mlp(nn.Module):
    """Two layers with an exact GELU between them."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(width, hidden)
        self.fc2 = nn.Linear(hidden, width)

    def forward(self, tokens: Tensor) -> Tensor:
        """Map (L, C) to (L, C)."""
        return self.fc2(functional.gelu(self.fc1(tokens)))


class SwinBlock(nn.Module):
    """One block; `shift` is 0 or half a window."""

    def __init__(self, width: int, heads: int, window: int, shift: int, mlp_ratio: int) -> None:
        super().__init__()
        self.window, self.shift = window, shift
        self.norm1 = nn.LayerNorm(width)
        self.attn = WindowAttention(width, heads, window)
        self.norm2 = nn.LayerNorm(width)
        self.mlp = Mlp(width, mlp_ratio * width)

    def forward(self, tokens: Tensor, size_hw: tuple[int, int]) -> Tensor:
        """Map the tokens (H * W, C) of a map to new ones; the given ones are overwritten."""
        at = windows(*size_hw, self.window, self.shift, tokens.device)
        mixed = tokens.new_empty(len(at.tokens), tokens.shape[1])
        n = self.window**2
        for some in torch.arange(len(at.padding)).split(TOKENS_AT_A_TIME // n):
            start, stop = int(some[0]), int(some[-1]) + 1
            inside = slice(start * n, stop * n)
            seams = None if at.seams is None else at.seams[start:stop]
            mixed[inside] = self.attn(self.norm1(tokens[at.tokens[inside]]), at.padding[start:stop], seams)
        for places, some in zip(at.places.split(TOKENS_AT_A_TIME), tokens.split(TOKENS_AT_A_TIME), strict=True):
            some += self.attn.proj(mixed[places])
            some += self.mlp(self.norm2(some))
        return tokens


class PatchMerging(nn.Module):
    """Halve a map, doubling its width."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(4 * width)
        self.reduction = nn.Linear(4 * width, 2 * width, bias=False)

    def forward(self, tokens: Tensor, size_hw: tuple[int, int]) -> Tensor:
        """Map (H * W, C) to (ceil(H / 2) * ceil(W / 2), 2C)."""
        height, width = size_hw
        grid = functional.pad(tokens.view(height, width, -1), (0, 0, 0, width % 2, 0, height % 2))
        four = [grid[0::2, 0::2], grid[1::2, 0::2], grid[0::2, 1::2], grid[1::2, 1::2]]
        return self.reduction(self.norm(torch.cat(four, dim=-1).flatten(0, 1)))


class SwinStage(nn.Module):
    """The blocks of one resolution, and the merging after them."""

    def __init__(self, config: SwinConfig, stage: int) -> None:
        super().__init__()
        width = config.widths[stage]
        self.blocks = nn.ModuleList(
            SwinBlock(width, config.heads[stage], config.window, config.window // 2 * (i % 2), config.mlp_ratio)
            for i in range(config.depths[stage])
        )
        if stage + 1 < len(config.depths):
            self.downsample = PatchMerging(width)


class PatchEmbedding(nn.Module):
    """One token per 4 x 4 pixels."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, width, 4, stride=4)
        self.norm = nn.LayerNorm(width)

    def forward(self, image: Tensor) -> tuple[Tensor, tuple[int, int]]:
        """Map (1, 3, H, W), sides multiples of 4, to tokens (H / 4 * W / 4, C) and the size of their map."""
        grid = self.proj(image)[0].permute(1, 2, 0)
        return self.norm(grid.reshape(-1, grid.shape[2])), (grid.shape[0], grid.shape[1])


class SwinTransformer(nn.Module):
    """Map an image to one map per stage, at strides 4, 8, 16, 32."""

    def __init__(self, config: SwinConfig) -> None:
        super().__init__()
        self.patch_embed = PatchEmbedding(config.width)
        self.layers = nn.ModuleList(SwinStage(config, i) for i in range(len(config.depths)))
        for i, width in enumerate(config.widths):
            self.add_module(f"norm{i}", nn.LayerNorm(width))

    def forward(self, image: Tensor) -> Sequence[Tensor]:
        """Map (1, 3, H, W), sides multiples of 32, to maps (1, C_i, H_i, W_i), finest first, in channels-last order."""
        tokens, (height, width) = self.patch_embed(image)
        maps: list[Tensor] = []
        for i, stage in enumerate(self.layers):
            for block in stage.blocks:  # pyright: ignore[reportGeneralTypeIssues, reportAttributeAccessIssue]
                tokens = block(tokens, (height, width))
            normed = self.get_submodule(f"norm{i}")(tokens)
            maps.append(normed.view(1, height, width, -1).permute(0, 3, 1, 2))
            if i + 1 < len(self.layers):
                tokens = stage.downsample(tokens, (height, width))  # pyright: ignore
                height, width = (height + 1) // 2, (width + 1) // 2
        return maps
