"""Masks from text and from boxes by SAM 3, without torchvision.

References:
    [Carion2025] SAM 3: Segment Anything with Concepts; run by the transformers library. Its processor and its pooling
    of box features need torchvision; both are written anew here, in behaviour, for builds without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import interpolate

from thinkgrasp.segmenters.boxes import box_iou, clip_boxes
from thinkgrasp.segmenters.image_cache import ImageCache
from thinkgrasp.segmenters.image_input import ImageInput
from thinkgrasp.segmenters.phrases import unread
from thinkgrasp.segmenters.pretrained import find_model, import_models, load_model, load_tokenizer
from thinkgrasp.segmenters.segment_anything import MASKS_AT_ONCE, BoxMasks
from thinkgrasp.types import Array

WHAT = "SAM 3"
KINDS = ("sam3", "sam3_video")
BOX_TEXT = "visual"
"""What SAM 3 is told where a box alone says what is meant."""
TEXT_TOKENS = 32
MASK_THRESHOLD = 0.5
_INPUT = ImageInput({"height": 1008, "width": 1008}, mean=(0.5, 0.5, 0.5), std=(0.5, 0.5, 0.5))


@dataclass(frozen=True, eq=False)
class ConceptMasks:
    """The masks that answer to one phrase, best first."""

    masks: NDArray[np.bool_]
    """(N, H, W)."""
    scores: Array
    """(N,) 0..1."""


class _Found(NamedTuple):
    """What the network says of one prompt: for each of its queries."""

    scores: Array
    """(Q,)."""
    boxes: Array
    """(Q, 4) [px]."""
    masks: Tensor
    """(Q, h, w) logits."""


class Sam3:
    """Finds what phrases name, and the thing in a box; an image is encoded once.

    Args:
        model: Folder, name of weights.toml or hub id.
        score_threshold: A mask is kept if its score is higher.
        batch: So many phrases or boxes run at once.
        device: As in `load_model`.
        dtype: As in `load_model`.
        cached_images: So many images' features are kept.

    Raises:
        ConfigError: The model is not there or is another.
        MissingDependency: The transformers library is not installed.
    """

    def __init__(
        self,
        model: str | Path = "sam3",
        *,
        score_threshold: float = 0.5,
        batch: int = 2,
        device: str | None = None,
        dtype: str | None = None,
        cached_images: int = 1,
    ) -> None:
        cls = import_models(_model_class, what=WHAT)
        folder = find_model(model, KINDS, what=WHAT)
        self._tokenizer = load_tokenizer(folder, what=WHAT)
        self._input = _INPUT.read(folder, what=WHAT)
        self._model: Any = load_model(cls, folder, what=WHAT, device=device, dtype=dtype)
        self.encoder = self._model.vision_encoder
        """From pixels to features; runs once per image."""
        self.score_threshold = score_threshold
        self.batch = batch
        self._cache = ImageCache[Any](cached_images)

    def find(self, image: NDArray[np.uint8], phrases: Sequence[str], *, most: int = 50) -> tuple[ConceptMasks, ...]:
        """Return the masks that answer to each phrase in an RGB image (H, W, 3), at most so many of each."""
        hw = (image.shape[0], image.shape[1])
        answers: list[ConceptMasks] = []
        for start in range(0, len(phrases), self.batch):
            for found in self._run(image, list(phrases[start : start + self.batch]), None):
                kept = np.flatnonzero(found.scores > self.score_threshold)
                kept = kept[np.argsort(-found.scores[kept], kind="stable")][:most]
                answers.append(ConceptMasks(_at_full_size(found.masks[kept], hw), found.scores[kept]))
        return tuple(answers)

    @property
    def text_limit(self) -> int:
        """So many tokens of a phrase are read."""
        return TEXT_TOKENS

    def unread(self, phrase: str) -> str:
        """Return the end of a phrase that is beyond the limit and so has no say, shortened; or nothing."""
        told = self._tokenizer(phrase, truncation=True, max_length=TEXT_TOKENS, return_offsets_mapping=True)
        return unread(phrase, told["offset_mapping"])

    def masks(self, image: NDArray[np.uint8], boxes: Array) -> BoxMasks:
        """Return the mask of the thing in each box (N, 4) x0, y0, x1, y1 [px] of an RGB image (H, W, 3).

        SAM 3 answers a box with all things like the one in it; of these, the one whose own box agrees best with the
        box that was given, and that it is surest of, is taken. Its score is returned.
        """
        hw = (image.shape[0], image.shape[1])
        masks, scores = [np.zeros((0, *hw), np.bool_)], [np.zeros(0, np.float32)]
        for start in range(0, len(boxes), self.batch):
            some = boxes[start : start + self.batch]
            for box, found in zip(some, self._run(image, [BOX_TEXT] * len(some), some), strict=True):
                best = np.array([np.argmax(box_iou(found.boxes, box[None])[:, 0] * found.scores)])
                masks.append(_at_full_size(found.masks[best], hw))
                scores.append(found.scores[best])
        return BoxMasks(np.concatenate(masks), np.concatenate(scores))

    @torch.inference_mode()
    def _run(self, image: NDArray[np.uint8], texts: list[str], boxes: Array | None) -> list[_Found]:
        features = self._cache.get(image, lambda: self._see(image))
        text = self._tokenizer(
            texts, padding="max_length", truncation=True, max_length=TEXT_TOKENS, return_tensors="pt"
        )
        text = {name: text[name].to(self._model.device) for name in ("input_ids", "attention_mask")}
        h, w = image.shape[:2]
        prompts = {} if boxes is None else {"input_boxes": self._prompts(boxes, (h, w))}
        out = self._model(vision_embeds=_repeated(features, len(texts)), **text, **prompts)
        scores = out.pred_logits.float().sigmoid() * out.presence_logits.float().sigmoid()
        corners = out.pred_boxes.float().cpu().numpy() * np.array([w, h, w, h], np.float32)
        return [
            _Found(scores[i].cpu().numpy(), clip_boxes(corners[i], (h, w)), out.pred_masks[i].float())
            for i in range(len(texts))
        ]

    def _see(self, image: NDArray[np.uint8]) -> Any:
        pixels = torch.from_numpy(self._input(image).pixels)[None].to(self._model.device, self._model.dtype)
        return self.encoder(pixels)

    def _prompts(self, boxes: Array, image_hw: tuple[int, int]) -> Tensor:
        """Return boxes (N, 4) [px] as (N, 1, 4) shares cx, cy, w, h."""
        h, w = image_hw
        shares = np.asarray(boxes, np.float32) / np.array([w, h, w, h], np.float32)
        centers, sides = (shares[:, :2] + shares[:, 2:]) / 2, shares[:, 2:] - shares[:, :2]
        prompts = torch.from_numpy(np.concatenate([centers, sides], axis=1))[:, None]
        return prompts.to(self._model.device, self._model.dtype)


def _at_full_size(logits: Tensor, hw: tuple[int, int]) -> NDArray[np.bool_]:
    """Return masks (N, H, W) from logits (N, h, w); probabilities, not logits, are interpolated, as in the library."""
    parts = [np.zeros((0, *hw), np.bool_)]
    for some in logits.split(MASKS_AT_ONCE) if len(logits) else ():
        full = interpolate(some.sigmoid()[None], hw, mode="bilinear", align_corners=False)[0]
        parts.append((full > MASK_THRESHOLD).cpu().numpy())
    return np.concatenate(parts)


def _repeated(features: Any, n: int) -> Any:
    """Return the features of one image for n prompts, without copying them."""
    from transformers.models.sam3.modeling_sam3 import Sam3VisionEncoderOutput

    maps, positions = (
        tuple(t.expand(n, -1, -1, -1) for t in cast(tuple[Tensor, ...], levels))
        for levels in (features.fpn_hidden_states, features.fpn_position_encoding)
    )
    return Sam3VisionEncoderOutput(fpn_hidden_states=maps, fpn_position_encoding=positions)


def roi_align(features: Tensor, boxes: Tensor, size: int) -> Tensor:
    """Return the mean features (N, C, size, size) of a grid of bins over boxes.

    Cell centres are at integers, a box has sides of at least one cell, and a bin is sampled as often per axis as it
    is long in cells, rounded up: what torchvision calls `aligned=False`.

    Args:
        features: (N, C, H, W), one map per box.
        boxes: (N, 4) x0, y0, x1, y1 [cells].
        size: Bins per side.

    References:
        [He2017] Mask R-CNN, section 3.
    """
    pooled = [_pooled(one, box, size) for one, box in zip(features, boxes.float().cpu(), strict=True)]
    return torch.stack(pooled) if pooled else features.new_zeros(0, features.shape[1], size, size)


def _pooled(features: Tensor, box: Tensor, size: int) -> Tensor:
    sides = (box[2:] - box[:2]).clamp(min=1)
    columns = _samples(float(box[0]), float(sides[0]), features.shape[2], size)
    rows = _samples(float(box[1]), float(sides[1]), features.shape[1], size)
    weights_x, weights_y = (w.to(features.device, features.dtype) for w in (columns, rows))
    return torch.einsum("ph,chw,qw->cpq", weights_y, features, weights_x)


def _samples(start: float, length: float, extent: int, size: int) -> Tensor:
    """Return how much of each cell goes into each bin of one axis, (size, extent)."""
    per_bin = max(1, int(np.ceil(length / size)))
    at = start + (torch.arange(size * per_bin) + 0.5) * (length / size / per_bin)
    counts = ((at >= -1) & (at <= extent)).float() / per_bin
    at = at.clamp(min=0, max=extent - 1)
    low = at.long()
    beyond = at - low
    weights = torch.zeros(size * per_bin, extent)
    weights.scatter_add_(1, low[:, None], (counts * (1 - beyond))[:, None])
    weights.scatter_add_(1, (low + 1).clamp(max=extent - 1)[:, None], (counts * beyond)[:, None])
    return weights.view(size, per_bin, extent).sum(dim=1)


def _model_class() -> Any:
    from transformers import Sam3Model
    from transformers.models.sam3.modeling_sam3 import Sam3GeometryEncoder, box_cxcywh_to_xyxy

    class GeometryEncoder(Sam3GeometryEncoder):
        """The library's, with box features pooled by `roi_align`."""

        def _encode_boxes(
            self, boxes: Tensor, boxes_mask: Tensor, boxes_labels: Tensor, vision_features: Tensor
        ) -> tuple[Tensor, Tensor]:
            n, per_image = boxes.shape[:2]
            h, w = vision_features.shape[-2:]
            corners = box_cxcywh_to_xyxy(boxes).flatten(0, 1) * boxes.new_tensor([w, h, w, h])
            maps = vision_features.repeat_interleave(per_image, dim=0)
            pooled = self.boxes_pool_project(roi_align(maps, corners, self.roi_size))
            embedded = self.boxes_direct_project(boxes) + pooled.view(n, per_image, self.hidden_size)
            place = self._encode_box_coordinates(*boxes.flatten(0, 1).unbind(-1)).view(n, per_image, -1)
            embedded = embedded + self.boxes_pos_enc_project(place.to(boxes.dtype))
            return self.label_embed(boxes_labels.long()) + embedded, boxes_mask

    class Sam3WithoutTorchvision(Sam3Model):
        """The library's, with the geometry encoder above; names of weights are the same."""

        def __init__(self, config: Any) -> None:
            super().__init__(config)
            self.geometry_encoder = GeometryEncoder(cast(Any, self.config.geometry_encoder_config))

    return Sam3WithoutTorchvision
