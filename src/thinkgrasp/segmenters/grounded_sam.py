"""Masks from text by GroundingDINO and Segment Anything: LangSAM's pair."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import ConfigError, MissingDependency
from thinkgrasp.segmenters.boxes import segment_of
from thinkgrasp.segmenters.marks import marked_segment
from thinkgrasp.segmenters.phrases import clean, cut_short
from thinkgrasp.types import Degradation, Plan, Scene, Segment, Segmentation

if TYPE_CHECKING:
    from thinkgrasp.segmenters.grounding_dino import Detections, GroundingDino
    from thinkgrasp.segmenters.segment_anything import MasksFromBoxes

PURPOSE = "the grounded_sam segmenter"


class GroundedSamSegmenter:
    """Answer a plan with the masks of what its text names.

    An image is encoded once by both networks; another phrase about it costs GroundingDINO's encoder and decoder, and
    SAM's decoder.

    Args:
        detector: GroundingDINO: a folder, a name of weights.toml, a hub id; or one that is loaded.
        masks: SAM or SAM 2 likewise; or whatever turns boxes into masks.
        box_threshold: A box is kept if any token of the text fits it better than this.
        text_threshold: And if a token of the phrase itself fits it better than this.
        max_iou: Of boxes that overlap more than this, the best is kept.
        max_segments: Keep at most this many.
        refine_marks: Where a plan names a proposal by its mark, ask for the mask in its box instead of using its own.
        together: `find` asks all its phrases in one caption, which is cheaper and lets them compete.
        device: "cpu", "cuda", ...; None = a CUDA device where there is one.
        dtype: "float32", "bfloat16", "float16"; None = float32.

    Raises:
        ConfigError: A setting is out of range, or a model is not there or is another.
        MissingDependency: torch or transformers is not installed.
    """

    def __init__(
        self,
        *,
        detector: str | Path | GroundingDino = "grounding-dino-tiny",
        masks: str | Path | MasksFromBoxes = "sam-vit-base",
        box_threshold: float = 0.3,
        text_threshold: float = 0.25,
        max_iou: float = 0.8,
        max_segments: int = 10,
        refine_marks: bool = False,
        together: bool = False,
        device: str | None = None,
        dtype: str | None = None,
    ) -> None:
        for name, value in (("box_threshold", box_threshold), ("text_threshold", text_threshold), ("max_iou", max_iou)):
            if not 0 <= value <= 1:
                raise ConfigError(f"grounded_sam segmenter: {name} must lie in [0, 1], got {value}")
        if max_segments < 1:
            raise ConfigError(f"grounded_sam segmenter: max_segments must be at least 1, got {max_segments}")
        try:
            from thinkgrasp.segmenters.grounding_dino import GroundingDino
            from thinkgrasp.segmenters.segment_anything import SegmentAnything
        except ModuleNotFoundError as error:
            if error.name != "torch":
                raise
            raise MissingDependency("torch", "langsam", PURPOSE) from None
        if isinstance(detector, str | Path):
            detector = GroundingDino(
                detector,
                box_threshold=box_threshold,
                text_threshold=text_threshold,
                max_iou=max_iou,
                together=together,
                device=device,
                dtype=dtype,
            )
        if isinstance(masks, str | Path):
            masks = SegmentAnything.shared(masks, device=device, dtype=dtype)
        self.detector = detector
        self.masks = masks
        self.max_segments = max_segments
        self.refine_marks = refine_marks

    def segment(self, scene: Scene, plan: Plan) -> Segmentation:
        """Return the planned mark's mask, or all masks that answer to the plan's text, best first.

        Raises:
            ContractError: The plan's mark is not in the scene.
        """
        if plan.mark is not None:
            return marked_segment(scene, plan, self.masks if self.refine_marks else None)
        (segments,) = self.find(scene.frame.color, [plan.target])
        notes = cut_short(self.detector, plan.target)
        if not segments:
            notes += (Degradation("segment", f"no box answers to {plan.target!r}", "no segment"),)
        return Segmentation(segments, notes)

    def find(self, image: NDArray[np.uint8], phrases: Sequence[str]) -> tuple[tuple[Segment, ...], ...]:
        """Return the segments that answer to each phrase in an RGB image (H, W, 3), best first."""
        said = [phrase for phrase in phrases if clean(phrase)]
        found = iter(self.detector.detect(image, said) if said else ())
        return tuple(self._segments(image, phrase, next(found)) if clean(phrase) else () for phrase in phrases)

    def _segments(self, image: NDArray[np.uint8], phrase: str, detections: Detections) -> tuple[Segment, ...]:
        boxes, scores = detections.boxes[: self.max_segments], detections.scores[: self.max_segments]
        masks = self.masks.masks(image, boxes).masks
        return tuple(
            segment_of(mask, phrase, float(score)) for mask, score in zip(masks, scores, strict=True) if mask.any()
        )
