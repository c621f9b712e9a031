"""Boxes from text by GroundingDINO.

References:
    [Liu2023] Grounding DINO: Marrying DINO with Grounded Pre-Training for Open-Set Object Detection; run by the
    transformers library, whose processor gives the same boxes and scores (tests/segmenters/test_grounding_dino.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from thinkgrasp.segmenters.boxes import clip_boxes, has_area, suppress
from thinkgrasp.segmenters.image_cache import ImageCache
from thinkgrasp.segmenters.image_input import ImageInput
from thinkgrasp.segmenters.phrases import Caption, unread
from thinkgrasp.segmenters.pretrained import find_model, import_models, load_model, load_tokenizer
from thinkgrasp.types import Array

WHAT = "GroundingDINO"
KINDS = ("grounding-dino",)
_INPUT = ImageInput({"shortest_edge": 800, "longest_edge": 1333})


@dataclass(frozen=True, eq=False)
class Detections:
    """The boxes that answer to one phrase, best first."""

    boxes: Array
    """(N, 4) x0, y0, x1, y1 [px], inside the image."""
    scores: Array
    """(N,) 0..1."""


class _Features(NamedTuple):
    """What the backbone makes of an image: maps with their masks, position codes, and the input's size."""

    maps: list[tuple[Tensor, Tensor]]
    positions: list[Tensor]
    input_hw: tuple[int, int]


class _GivenFeatures(nn.Module):
    """Stands in for the backbone and returns features that were computed before, for a batch of any size."""

    def __init__(self, position_embedding: nn.Module) -> None:
        super().__init__()
        self.position_embedding = position_embedding
        self.features: _Features | None = None

    def forward(self, pixel_values: Tensor, pixel_mask: Tensor) -> tuple[list[tuple[Tensor, Tensor]], list[Tensor]]:
        """Return new lists each time, since the model appends to them."""
        n = len(pixel_values)
        maps, positions, _ = cast(_Features, self.features)
        return [(m.expand(n, -1, -1, -1), k.expand(n, -1, -1)) for m, k in maps], [
            p.expand(n, -1, -1, -1) for p in positions
        ]


class GroundingDino:
    """Finds what phrases name.

    The backbone sees an image once; the encoder mixes image and text and has to run for every phrase.

    Args:
        model: Folder, name of weights.toml or hub id.
        box_threshold: A box is kept if any token of the caption fits it better than this.
        text_threshold: It answers to the phrase with the best token, which has to fit better than this.
        max_iou: Of boxes for one phrase that overlap more than this, the best is kept.
        together: Ask all phrases in one caption, or in as few as its length allows: the cost of one, but they compete
            and are seen in one context.
        batch: So many captions run at once.
        device: As in `load_model`.
        dtype: As in `load_model`.
        cached_images: So many images' features are kept.

    Raises:
        ConfigError: The model is not there or is another.
        MissingDependency: The transformers library is not installed.
    """

    def __init__(
        self,
        model: str | Path = "grounding-dino-tiny",
        *,
        box_threshold: float = 0.3,
        text_threshold: float = 0.25,
        max_iou: float = 0.8,
        together: bool = False,
        batch: int = 4,
        device: str | None = None,
        dtype: str | None = None,
        cached_images: int = 2,
    ) -> None:
        cls = import_models(_model_class, what=WHAT)
        folder = find_model(model, KINDS, what=WHAT)
        self._tokenizer = load_tokenizer(folder, what=WHAT)
        self._input = _INPUT.read(folder, what=WHAT)
        self._model: Any = load_model(cls, folder, what=WHAT, device=device, dtype=dtype)
        self.backbone = cast(nn.Module, self._model.model.backbone)
        """From pixels to features; runs once per image."""
        self._given = _GivenFeatures(cast(nn.Module, self._model.model.backbone.position_embedding))
        self._model.model.backbone = self._given
        self.box_threshold = box_threshold
        self.text_threshold = text_threshold
        self.max_iou = max_iou
        self.together = together
        self.batch = batch
        self._cache = ImageCache[_Features](cached_images)

    def detect(self, image: NDArray[np.uint8], phrases: Sequence[str]) -> tuple[Detections, ...]:
        """Return the boxes that answer to each phrase in an RGB image (H, W, 3)."""
        captions = self._together(phrases) if self.together else [Caption.of([phrase]) for phrase in phrases]
        found: list[Detections] = []
        for start in range(0, len(captions), self.batch):
            some = captions[start : start + self.batch]
            logits, boxes, tokens = self._run(image, [caption.text for caption in some])
            for row, caption in enumerate(some):
                found += self._read(logits[row], boxes[row], caption.tokens(tokens[row]), image.shape[:2])
        return tuple(found)

    @property
    def text_limit(self) -> int:
        """So many tokens of a caption are read."""
        return int(self._model.config.max_text_len)

    def unread(self, phrase: str) -> str:
        """Return the end of a phrase that is beyond the limit and so has no say, shortened; or nothing."""
        text = Caption.of([phrase]).text
        return unread(text, self._offsets(text))

    def _offsets(self, text: str) -> list[tuple[int, int]]:
        told = self._tokenizer(text, truncation=True, max_length=self.text_limit, return_offsets_mapping=True)
        return cast(list[tuple[int, int]], told["offset_mapping"])

    def _together(self, phrases: Sequence[str]) -> list[Caption]:
        """All phrases in one caption; where it is too long in several, each as long as may be."""
        groups: list[list[str]] = [[]]
        for phrase in phrases:
            longer = Caption.of([*groups[-1], phrase]).text
            if groups[-1] and unread(longer, self._offsets(longer)):
                groups.append([])
            groups[-1].append(phrase)
        return [Caption.of(group) for group in groups if group]

    @torch.inference_mode()
    def _run(self, image: NDArray[np.uint8], texts: list[str]) -> tuple[Array, Array, list[list[tuple[int, int]]]]:
        """Return logits (B, Q, T), boxes (B, Q, 4) as shares cx, cy, w, h, and each token's place in its text."""
        self._given.features = self._cache.get(image, lambda: self._see(image))
        text = self._tokenizer(
            texts,
            padding=True,
            truncation=True,
            max_length=self.text_limit,
            return_offsets_mapping=True,
            return_tensors="pt",
        )
        offsets = cast(list[list[tuple[int, int]]], text.pop("offset_mapping").tolist())
        device = self._model.device
        # The model asks the pixels for their shape alone, so one number stands for all of them.
        h, w = self._given.features.input_hw
        blank = torch.zeros((), device=device, dtype=self._model.dtype).expand(len(texts), 3, h, w)
        mask = torch.ones((), device=device, dtype=torch.long).expand(len(texts), h, w)
        out = self._model(pixel_values=blank, pixel_mask=mask, **text.to(device))
        return out.logits.float().cpu().numpy(), out.pred_boxes.float().cpu().numpy(), offsets

    def _see(self, image: NDArray[np.uint8]) -> _Features:
        network_image = self._input(image)
        pixels = torch.from_numpy(network_image.pixels)[None].to(self._model.device, self._model.dtype)
        mask = torch.ones(1, *network_image.size_hw, dtype=torch.long, device=pixels.device)
        maps, positions = self.backbone(pixels, mask)
        return _Features(list(maps), list(positions), network_image.size_hw)

    def _read(
        self, logits: Array, boxes: Array, tokens: tuple[tuple[int, ...], ...], image_hw: tuple[int, int]
    ) -> list[Detections]:
        """Sort the boxes of one caption by phrase."""
        fits = (1 / (1 + np.exp(-np.clip(logits, -80, 80)))).astype(np.float32)
        fits[logits == -np.inf] = 0
        scores = fits.max(axis=1)
        by_phrase = np.stack([fits[:, t].max(axis=1) if t else np.zeros(len(fits), np.float32) for t in tokens], axis=1)
        best = by_phrase.argmax(axis=1)
        answers = (scores > self.box_threshold) & (by_phrase.max(axis=1) > self.text_threshold)
        half = boxes[:, 2:] / 2
        corners = np.concatenate([boxes[:, :2] - half, boxes[:, :2] + half], axis=1)
        h, w = image_hw
        corners = clip_boxes(corners * np.array([w, h, w, h], np.float32), image_hw)
        answers &= has_area(corners)
        found: list[Detections] = []
        for phrase in range(len(tokens)):
            mine = np.flatnonzero(answers & (best == phrase))
            kept = mine[suppress(corners[mine], scores[mine], self.max_iou)]
            found.append(Detections(corners[kept], scores[kept]))
        return found


def _model_class() -> Any:
    from transformers import GroundingDinoForObjectDetection

    return GroundingDinoForObjectDetection
