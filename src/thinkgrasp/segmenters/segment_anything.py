"""Masks from boxes by Segment Anything (SAM) and SAM 2.

References:
    [Kirillov2023] Segment Anything; [Ravi2024] SAM 2: Segment Anything in Images and Videos; run by the transformers
    library, whose processors give the same masks (tests/segmenters/test_segment_anything.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol
from weakref import WeakValueDictionary

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import interpolate

from thinkgrasp.segmenters.image_cache import ImageCache
from thinkgrasp.segmenters.image_input import ImageInput
from thinkgrasp.segmenters.pretrained import find_model, import_models, load_model, model_type
from thinkgrasp.types import Array

WHAT = "Segment Anything"
KINDS = ("sam", "sam2", "sam2_video")
_INPUTS = {
    "sam": ImageInput({"longest_edge": 1024}, pad_hw=(1024, 1024)),
    "sam2": ImageInput({"height": 1024, "width": 1024}),
}
MASKS_AT_ONCE = 8
"""So many masks are brought to the image's size at a time; it bounds the memory."""


@dataclass(frozen=True, eq=False)
class BoxMasks:
    """One mask per box."""

    masks: NDArray[np.bool_]
    """(N, H, W)."""
    scores: Array
    """(N,) how well the network believes the mask to fit: its guess of the intersection over union."""


class MasksFromBoxes(Protocol):
    """Whatever turns boxes into masks: SAM, SAM 2, SAM 3."""

    def masks(self, image: NDArray[np.uint8], boxes: Array) -> BoxMasks:
        """Return the masks of boxes (N, 4) x0, y0, x1, y1 [px] in an RGB image (H, W, 3)."""
        ...


@dataclass(frozen=True)
class _Embedding:
    """What the image encoder makes of an image; SAM 2 keeps three sizes."""

    maps: Tensor | list[Tensor]
    size_hw: tuple[int, int]


class SegmentAnything:
    """Turns boxes into masks; an image is encoded once, and each box costs the small decoder alone.

    Args:
        model: Folder, name of weights.toml or hub id: SAM of any size, or SAM 2.
        device: As in `load_model`.
        dtype: As in `load_model`.
        cached_images: So many images' embeddings are kept.

    Raises:
        ConfigError: The model is not there or is another.
        MissingDependency: The transformers library is not installed.
    """

    def __init__(
        self,
        model: str | Path = "sam-vit-base",
        *,
        device: str | None = None,
        dtype: str | None = None,
        cached_images: int = 2,
    ) -> None:
        classes = import_models(_model_classes, what=WHAT)
        folder = find_model(model, KINDS, what=WHAT)
        self._generation = "sam" if model_type(folder, what=WHAT) == "sam" else "sam2"
        self._input = _INPUTS[self._generation].read(folder, what=WHAT)
        self._model: Any = load_model(classes[self._generation], folder, what=WHAT, device=device, dtype=dtype)
        self.encoder = self._model.vision_encoder
        """From pixels to features; runs once per image."""
        self._cache = ImageCache[_Embedding](cached_images)

    @classmethod
    def shared(cls, model: str | Path, *, device: str | None = None, dtype: str | None = None) -> SegmentAnything:
        """Return the one that is in use with these settings, or make it: weights and embeddings are then shared."""
        key = (str(model), device, dtype)
        found = _SHARED.get(key)
        if found is None:
            found = _SHARED[key] = cls(model, device=device, dtype=dtype)
        return found

    @torch.inference_mode()
    def masks(self, image: NDArray[np.uint8], boxes: Array) -> BoxMasks:
        """Return the masks of boxes (N, 4) x0, y0, x1, y1 [px] in an RGB image (H, W, 3)."""
        hw = (image.shape[0], image.shape[1])
        if len(boxes) == 0:
            return BoxMasks(np.zeros((0, *hw), np.bool_), np.zeros(0, np.float32))
        embedding = self._cache.get(image, lambda: self._see(image))
        scale = np.tile(np.array(embedding.size_hw[::-1]) / np.array(hw[::-1]), 2)
        prompts = torch.from_numpy(np.asarray(boxes, np.float64) * scale)[None]
        out = self._model(
            image_embeddings=list(embedding.maps) if isinstance(embedding.maps, list) else embedding.maps,
            input_boxes=prompts.to(self._model.device, self._model.dtype),
            multimask_output=False,
        )
        low = out.pred_masks[0].float()
        full = [self._at_full_size(low[i : i + MASKS_AT_ONCE], embedding.size_hw, hw) for i in _starts(len(low))]
        return BoxMasks(np.concatenate(full), out.iou_scores[0, :, 0].float().cpu().numpy())

    def _see(self, image: NDArray[np.uint8]) -> _Embedding:
        network_image = self._input(image)
        pixels = torch.from_numpy(network_image.pixels)[None].to(self._model.device, self._model.dtype)
        return _Embedding(self._model.get_image_embeddings(pixels), network_image.size_hw)

    def _at_full_size(self, low: Tensor, size_hw: tuple[int, int], hw: tuple[int, int]) -> NDArray[np.bool_]:
        """Return masks (N, H, W) from logits (N, 1, h, w); SAM's include the padding, SAM 2 has none."""
        if self._input.pad_hw is not None:
            low = interpolate(low, self._input.pad_hw, mode="bilinear", align_corners=False)
            low = low[..., : size_hw[0], : size_hw[1]]
        return (interpolate(low, hw, mode="bilinear", align_corners=False)[:, 0] > 0).cpu().numpy()


_SHARED: WeakValueDictionary[tuple[str, str | None, str | None], SegmentAnything] = WeakValueDictionary()


def _starts(n: int) -> range:
    return range(0, n, MASKS_AT_ONCE)


def _model_classes() -> dict[str, Any]:
    from transformers import Sam2Model, SamModel

    return {"sam": SamModel, "sam2": Sam2Model}
