"""VLPart: scored boxes of objects and of their parts, for any names given as text vectors.

Licence: this is our own code, written from the published description of the model. VLPart itself is MIT
(facebookresearch/VLPart), detectron2 Apache-2.0; the checkpoint swinbase_part_0a0000.pth that the ThinkGrasp paper
used is a release of Cheems-Seminar/grounded-segment-any-parts, a project under CC-BY-NC-4.0.

References:
    [Sun2023] Going Denser with Open-Vocabulary Part Segmentation; checked against ../shared/vlpart, which was made with
    the original code.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Literal, NamedTuple, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor, nn
from torch.nn import functional

from thinkgrasp.errors import ConfigError, InputError
from thinkgrasp.networks import boxes as bx
from thinkgrasp.networks import proposals as rpn
from thinkgrasp.networks.cascade_head import CascadeHead
from thinkgrasp.networks.checkpoint import load_strictly, ready
from thinkgrasp.networks.fpn import FeaturePyramid
from thinkgrasp.networks.swin import SwinConfig, SwinTransformer

WHAT = "VLPart"
MEAN_RGB = (123.675, 116.28, 103.53)
STD_RGB = (58.395, 57.12, 57.375)
DIVISOR = 32
"""The padded image's sides are multiples of it."""
STRIDES = (4, 8, 16, 32, 64)
ANCHOR_SIZES = (32, 64, 128, 256, 512)
"""Of p2..p6 [px]."""

Variant = Literal["paper", "upstream"]


@dataclass(frozen=True)
class Selection:
    """Which boxes are kept: what the ThinkGrasp paper's copy and upstream VLPart do differently.

    Scores of the two are not comparable: upstream's is a geometric mean with the proposal's objectness.
    """

    proposals_before_nms: int
    """Per level."""
    proposals: int
    uses_objectness: bool
    background: Literal["text", "zeros"]
    """The text matrix's last column; it is dropped again and changes no score."""
    min_score: float
    """A box must score more, before overlaps are removed."""
    detections: int = 100
    proposal_nms: float = 0.7
    nms: float = 0.5


VARIANTS: dict[Variant, Selection] = {
    "paper": Selection(6000, 1000, uses_objectness=False, background="text", min_score=0.0),
    "upstream": Selection(1000, 1000, uses_objectness=True, background="zeros", min_score=0.05),
}


@dataclass(frozen=True)
class VLPartConfig:
    """Sizes of the network; the defaults are those of the Swin-B checkpoint."""

    swin: SwinConfig = field(default_factory=SwinConfig)
    channels: int = 256
    """Of the feature pyramid."""
    head_width: int = 1024
    text_width: int = 1024
    short_side_px: int = 800
    long_side_px: int = 1333
    """The image is enlarged or reduced to this short side, unless its long side would be longer than this."""
    selection: Selection = VARIANTS["paper"]

    def __post_init__(self) -> None:
        swin = self.swin
        if not len(swin.depths) == len(swin.heads) == 4:
            raise ConfigError(f"{WHAT}: Swin has 4 stages, got depths {swin.depths} and heads {swin.heads}")
        if any(width % heads for width, heads in zip(swin.widths, swin.heads, strict=True)):
            raise ConfigError(f"{WHAT}: the stages' widths {swin.widths} must be multiples of the heads {swin.heads}")
        if not 0 < self.short_side_px <= self.long_side_px:
            raise ConfigError(f"{WHAT}: sides must be 0 < short <= long, got {self.short_side_px}, {self.long_side_px}")

    def variant(self, name: Variant) -> VLPartConfig:
        """Return a copy that selects as this variant does.

        Raises:
            ConfigError: There is no such variant.
        """
        if name not in VARIANTS:
            raise ConfigError(f"{WHAT}: variant must be one of {', '.join(get_args(Variant))}, got {name!r}")
        return replace(self, selection=VARIANTS[name])


class NetworkImage(NamedTuple):
    """An image as the network sees it."""

    pixels: Tensor
    """(1, 3, H, W) float32 RGB, normalised, zero padded at the right and bottom to multiples of 32."""
    size_hw: tuple[int, int]
    """Without the padding."""
    original_hw: tuple[int, int]


class Regions(NamedTuple):
    """What an image holds, whatever it will be asked for: N boxes and what to multiply texts with."""

    boxes: Tensor
    """(N, 4) float32 [px of the network's image], not clipped."""
    queries: Tensor
    """(3, N, text_width) float32, of the stages."""
    objectness: Tensor
    """(N,) float32 logits of the proposals."""
    size_hw: tuple[int, int]
    original_hw: tuple[int, int]


class Detections(NamedTuple):
    """Boxes with the class each was found for, best first."""

    boxes: Tensor
    """(D, 4) float32 [px]."""
    scores: Tensor
    """(D,) float32, 0..1."""
    classes: Tensor
    """(D,) int64 index of the name."""
    rows: Tensor
    """(D,) int64 region that it comes from."""


class VLPart(nn.Module):
    """The detector; `load_vlpart` makes one from weights."""

    def __init__(self, config: VLPartConfig) -> None:
        super().__init__()
        self.config = config
        self.backbone = FeaturePyramid(SwinTransformer(config.swin), config.swin.widths, config.channels)
        self.proposal_generator = nn.ModuleDict({"rpn_head": rpn.RPNHead(config.channels)})
        self.roi_heads = CascadeHead(config.channels, config.head_width, config.text_width)

    @property
    def device(self) -> torch.device:
        """Where the weights are."""
        return self.backbone.fpn_lateral2.weight.device  # pyright: ignore

    @property
    def dtype(self) -> torch.dtype:
        """Of the weights; boxes, logits and scores are float32 throughout."""
        return self.backbone.fpn_lateral2.weight.dtype  # pyright: ignore

    @torch.no_grad()
    def regions(self, rgb: NDArray[np.uint8]) -> Regions:
        """Look at an image (H, W, 3) uint8 RGB.

        Raises:
            InputError: It is no such image.
        """
        image = prepare(rgb, self.config)
        maps = self.pyramid(image)
        proposals = self.propose(maps, image.size_hw)
        boxes, queries = self.roi_heads(maps[:-1], proposals.boxes, image.size_hw)
        return Regions(boxes, queries, proposals.logits, image.size_hw, image.original_hw)

    @torch.no_grad()
    def detect(self, regions: Regions, text: Tensor) -> Detections:
        """Return the boxes of the original image that answer to names.

        Args:
            regions: Of the image.
            text: (text_width, C + 1), as `text_matrix` makes it.
        """
        found = select_detections(regions.boxes, self.scores(regions, text), regions.size_hw, self.config.selection)
        return to_original(found, regions.size_hw, regions.original_hw)

    @torch.no_grad()
    def pyramid(self, image: NetworkImage) -> list[Tensor]:
        """Return the feature maps p2..p6."""
        pixels = image.pixels.to(self.device, self.dtype)
        return self.backbone(pixels.contiguous(memory_format=torch.channels_last))

    @torch.no_grad()
    def propose(self, maps: list[Tensor], size_hw: tuple[int, int]) -> rpn.Proposals:
        """Return the proposals of p2..p6, inside the unpadded image."""
        selection = self.config.selection
        levels: list[rpn.Proposals] = []
        for level, stride, size in zip(maps, STRIDES, ANCHOR_SIZES, strict=True):
            logits, deltas = self.proposal_generator["rpn_head"](level)
            anchors = _anchors((level.shape[2], level.shape[3]), stride, size, level.device)
            levels.append(rpn.best_of_level(logits, deltas, anchors, selection.proposals_before_nms))
        return rpn.select(levels, size_hw, threshold=selection.proposal_nms, limit=selection.proposals)

    def scores(self, regions: Regions, text: Tensor) -> Tensor:
        """Return (N, C + 1) scores of regions for each column of a text matrix."""
        mean = torch.sigmoid(regions.queries @ text.to(regions.queries)).mean(dim=0)
        if self.config.selection.uses_objectness:
            mean = torch.sqrt(mean * torch.sigmoid(regions.objectness)[:, None])
        return mean


def load_vlpart(
    weights: Mapping[str, Tensor],
    config: VLPartConfig | None = None,
    *,
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float32,
) -> tuple[VLPart, tuple[str, ...]]:
    """Make the network and load its weights, all of them.

    Args:
        weights: By the official checkpoint's names; the network keeps those that need no conversion.
        config: Sizes; None = the Swin-B checkpoint's.
        device: Where it runs.
        dtype: Of the weights and maps.

    Returns:
        The network, and the names in `weights` that it does not use.

    Raises:
        ConfigError: Weights are missing or of another shape.
    """
    with torch.device("meta"):
        model = VLPart(config or VLPartConfig())
    unused = load_strictly(model, weights, what=WHAT, assign=True)
    return ready(model, device, dtype).to(memory_format=torch.channels_last), unused  # pyright: ignore


def network_size(size_hw: tuple[int, int], config: VLPartConfig) -> tuple[int, int]:
    """Return the size (h, w) to which an image is resized."""
    height, width = size_hw
    scale = config.short_side_px / min(height, width)
    if height < width:
        tall, wide = float(config.short_side_px), scale * width
    else:
        tall, wide = scale * height, float(config.short_side_px)
    if max(tall, wide) > config.long_side_px:  # of the already scaled sides: one factor for both would round otherwise
        shrink = config.long_side_px / max(tall, wide)
        tall, wide = tall * shrink, wide * shrink
    return int(tall + 0.5), int(wide + 0.5)


def prepare(rgb: NDArray[np.uint8], config: VLPartConfig) -> NetworkImage:
    """Resize, normalise and pad an image (H, W, 3) uint8 RGB.

    Raises:
        InputError: It is no such image, or so thin that a side would vanish.
    """
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8 or 0 in rgb.shape:
        raise InputError(f"{WHAT}: the image must be (H, W, 3) uint8 RGB, got {rgb.shape} {rgb.dtype}")
    original = (rgb.shape[0], rgb.shape[1])
    height, width = size = network_size(original, config)
    if 0 in size:
        raise InputError(f"{WHAT}: an image of {original[1]}x{original[0]} is too thin; crop it to its content")
    resized = np.array(Image.fromarray(rgb).resize((width, height), Image.Resampling.BILINEAR))
    pixels = torch.from_numpy(resized).permute(2, 0, 1).float()
    pixels = (pixels - torch.tensor(MEAN_RGB)[:, None, None]) / torch.tensor(STD_RGB)[:, None, None]
    return NetworkImage(functional.pad(pixels, (0, -width % DIVISOR, 0, -height % DIVISOR))[None], size, original)


def select_detections(boxes: Tensor, scores: Tensor, size_hw: tuple[int, int], selection: Selection) -> Detections:
    """Return the best detections: clipped boxes with scores above the least, without overlaps within a class.

    A box may answer to several names, and the background competes with none.

    Args:
        boxes: (N, 4) [px of the network's image].
        scores: (N, C + 1), the last column the background's.
        size_hw: The network's image without padding.
        selection: What is kept.
    """
    kept = (torch.isfinite(boxes).all(dim=1) & torch.isfinite(scores).all(dim=1)).nonzero()[:, 0]
    boxes, scores = bx.clip(boxes[kept], size_hw), scores[kept, :-1]
    rows, classes = (scores > selection.min_score).nonzero(as_tuple=True)
    boxes, scores = boxes[rows], scores[rows, classes]
    best = bx.grouped_nms(boxes, scores, classes, selection.nms, limit=selection.detections)
    return Detections(boxes[best], scores[best], classes[best], kept[rows[best]])


def to_original(found: Detections, size_hw: tuple[int, int], original_hw: tuple[int, int]) -> Detections:
    """Return detections of the network's image in the original one; those left without area are dropped."""
    (height, width), (tall, wide) = original_hw, size_hw
    factors = found.boxes.new_tensor([width / wide, height / tall, width / wide, height / tall])
    boxes = bx.clip(found.boxes * factors, original_hw)
    keep = bx.has_area(boxes)
    return Detections(boxes[keep], found.scores[keep], found.classes[keep], found.rows[keep])


def text_matrix(features: Tensor, background: Tensor | None, selection: Selection) -> Tensor:
    """Return (text_width, C + 1) unit columns of the names' features (C, text_width) and of the background's.

    Args:
        features: As the text tower returns them.
        background: (text_width,) of the word "background"; None = zeros, which change no score.
        selection: Says what the variant takes for the background.
    """
    last = background if selection.background == "text" else None
    last = features.new_zeros(features.shape[1]) if last is None else last
    return functional.normalize(torch.cat([features, last[None]]).float(), dim=1, eps=1e-12).T.contiguous()


@lru_cache(maxsize=16)
def _anchors(size_hw: tuple[int, int], stride: int, size: int, device: torch.device) -> Tensor:
    return rpn.grid_anchors(size_hw, stride, size).to(device)
