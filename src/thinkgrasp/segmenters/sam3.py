"""Masks from text by SAM 3, which finds and outlines in one network."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import ConfigError, MissingDependency
from thinkgrasp.segmenters.boxes import segment_of
from thinkgrasp.segmenters.marks import marked_segment
from thinkgrasp.segmenters.phrases import cut_short
from thinkgrasp.types import Degradation, Plan, Scene, Segment, Segmentation

if TYPE_CHECKING:
    from thinkgrasp.segmenters.sam3_network import ConceptMasks, Sam3

PURPOSE = "the sam3 segmenter"


class Sam3Segmenter:
    """Answer a plan with the masks of what its text names.

    Args:
        model: A folder, a name of weights.toml, a hub id; or a network that is loaded.
        score_threshold: A mask is kept if its score is higher.
        max_segments: Keep at most this many.
        refine_marks: Where a plan names a proposal by its mark, ask for the mask in its box instead of using its own.
        device: "cpu", "cuda", ...; None = a CUDA device where there is one.
        dtype: "float32", "bfloat16", "float16"; None = float32.

    Raises:
        ConfigError: A setting is out of range, or the model is not there or is another.
        MissingDependency: torch or transformers is not installed.
    """

    def __init__(
        self,
        *,
        model: str | Path | Sam3 = "sam3",
        score_threshold: float = 0.5,
        max_segments: int = 10,
        refine_marks: bool = False,
        device: str | None = None,
        dtype: str | None = None,
    ) -> None:
        if not 0 <= score_threshold <= 1:
            raise ConfigError(f"sam3 segmenter: score_threshold must lie in [0, 1], got {score_threshold}")
        if max_segments < 1:
            raise ConfigError(f"sam3 segmenter: max_segments must be at least 1, got {max_segments}")
        try:
            from thinkgrasp.segmenters.sam3_network import Sam3
        except ModuleNotFoundError as error:
            if error.name != "torch":
                raise
            raise MissingDependency("torch", "langsam", PURPOSE) from None
        if isinstance(model, str | Path):
            model = Sam3(model, score_threshold=score_threshold, device=device, dtype=dtype)
        self.network = model
        self.max_segments = max_segments
        self.refine_marks = refine_marks

    def segment(self, scene: Scene, plan: Plan) -> Segmentation:
        """Return the planned mark's mask, or all masks that answer to the plan's text, best first.

        Raises:
            ContractError: The plan's mark is not in the scene.
        """
        if plan.mark is not None:
            return marked_segment(scene, plan, self.network if self.refine_marks else None)
        (segments,) = self.find(scene.frame.color, [plan.target])
        notes = cut_short(self.network, plan.target)
        if not segments:
            notes += (Degradation("segment", f"no mask answers to {plan.target!r}", "no segment"),)
        return Segmentation(segments, notes)

    def find(self, image: NDArray[np.uint8], phrases: Sequence[str]) -> tuple[tuple[Segment, ...], ...]:
        """Return the segments that answer to each phrase in an RGB image (H, W, 3), best first."""
        said = [phrase for phrase in phrases if phrase.strip()]
        answers = dict(zip(said, self.network.find(image, said, most=self.max_segments), strict=True))
        return tuple(_segments(phrase, answers.get(phrase)) for phrase in phrases)


def _segments(phrase: str, found: ConceptMasks | None) -> tuple[Segment, ...]:
    if found is None:
        return ()
    pairs = zip(found.masks, found.scores, strict=True)
    return tuple(segment_of(mask, phrase, float(score)) for mask, score in pairs if mask.any())
