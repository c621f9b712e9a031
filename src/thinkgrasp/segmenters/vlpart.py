"""Masks of objects and of their parts ("mug:handle") from VLPart's boxes.

Licence: our own code. Upstream VLPart is MIT; the copy in the ThinkGrasp paper's repository, and the checkpoint
swinbase_part_0a0000.pth that it names, come from a project under CC-BY-NC-4.0 (no commercial use). Weights are not part
of this package.

References:
    [Sun2023] Going Denser with Open-Vocabulary Part Segmentation; the ThinkGrasp paper, which refines the boxes by SAM.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import ConfigError, InputError, MissingDependency
from thinkgrasp.segmenters.box_masks import BoxMask, MaskModel, model_masks, scene_mask
from thinkgrasp.types import Degradation, Mask, Plan, PlanKind, Proposal, Scene, Segment, Segmentation
from thinkgrasp.weights import locate_file

if TYPE_CHECKING:
    from thinkgrasp.networks.part_finder import PartFinder
    from thinkgrasp.networks.vlpart import VLPartConfig

THRESHOLD = 0.3
"""The paper takes 0.7; good parts are reported at 0.3 to 0.6."""
FILL_PX = 400
"""Holes of a model's mask that are smaller than this are filled, as in the paper."""
CACHE = "~/.cache/thinkgrasp/vlpart"
INSIDE = 0.5
"""With a planned mark: this share of a box must lie in the box of the marked proposal."""


class VLPartSegmenter:
    """Answer a plan with the masks of the boxes that VLPart finds for its target.

    Args:
        weights: VLPart's checkpoint, or a name of weights.toml; None = the paper's, if it is on this machine.
        text_weights: CLIP's RN50.pt, or another file that holds its text tower; None = the one in `weights`.
        text_table: A .npz of fixed names and their vectors, instead of a text tower.
        tokenizer: Folder of CLIP's tokeniser, or its repository on the hub, already downloaded; None = OpenAI's.
        tokenizer_revision: Commit of that repository; None = the pinned one.
        cache_folder: Where vectors of names are kept; None = nowhere.
        variant: "paper" or "upstream": which boxes are kept, and how they are scored. Their scores are not comparable.
        threshold: A box must score at least this.
        max_segments: Keep at most this many.
        device: None = a CUDA device where there is one, else the CPU.
        dtype: "float32", "bfloat16" or "float16".
        masker: What turns boxes into masks: a model, or the name or folder of a SAM, which is shared with other
            segmenters that use it; None = the scene's proposals and depth, which is said.
        config: Sizes of the network; None = the Swin-B checkpoint's.

    Raises:
        ConfigError: A setting is not allowed, or a file of weights cannot be used.
        MissingDependency: torch or transformers is not installed.
    """

    def __init__(
        self,
        *,
        weights: str | Path | None = None,
        text_weights: str | Path | None = None,
        text_table: str | Path | None = None,
        tokenizer: str | Path | None = None,
        tokenizer_revision: str | None = None,
        cache_folder: str | Path | None = CACHE,
        variant: Literal["paper", "upstream"] = "paper",
        threshold: float = THRESHOLD,
        max_segments: int = 10,
        device: str | None = None,
        dtype: str = "float32",
        masker: MaskModel | str | Path | None = None,
        config: VLPartConfig | None = None,
    ) -> None:
        if isinstance(threshold, bool) or not 0 <= threshold < 1:
            raise ConfigError(f"vlpart segmenter: threshold must lie in [0, 1), got {threshold!r}")
        if isinstance(max_segments, bool) or not isinstance(max_segments, int) or max_segments < 1:
            raise ConfigError(f"vlpart segmenter: max_segments must be a whole number above 0, got {max_segments!r}")
        if not (masker is None or isinstance(masker, str | Path) or callable(getattr(masker, "masks", None))):
            raise ConfigError(f"vlpart segmenter: masker must have a method masks, got {type(masker).__name__}")
        file = locate_file(weights, default="vlpart-swin-base", what="vlpart segmenter")
        try:
            from thinkgrasp.networks.part_finder import PartFinder, TextSource
        except ModuleNotFoundError as error:
            if error.name != "torch":
                raise
            raise MissingDependency("torch", "langsam", "the vlpart segmenter") from None
        defaults = TextSource()
        text = TextSource(
            weights=text_weights,
            table=text_table,
            tokenizer=tokenizer or defaults.tokenizer,
            tokenizer_revision=tokenizer_revision or defaults.tokenizer_revision,
            cache=None if cache_folder is None else Path(cache_folder).expanduser(),
        )
        self.finder: PartFinder = PartFinder(file, text, variant=variant, config=config, device=device, dtype=dtype)
        self.threshold = threshold
        self.max_segments = max_segments
        self.masker = _shared_sam(masker, device) if isinstance(masker, str | Path) else masker

    def segment(self, scene: Scene, plan: Plan) -> Segmentation:
        """Return a mask for each box of the plan's target, best first.

        With a planned mark, only boxes on that proposal count. An obstruction is returned alone.

        Raises:
            ContractError: The plan's mark is not in the scene, or `masker` broke its contract.
        """
        planned = scene.proposal(plan.mark) if plan.mark is not None else None
        name = part_name(plan.target, plan.kind)
        try:
            found = self.finder.find(scene.frame.color, [name] if name else [])
        except InputError as error:
            return Segmentation((), (Degradation("segment", str(error), "no segment"),))
        degraded = [Degradation("segment", note, "the vector is computed again") for note in self.finder.notes()]
        on_it = [i for i, box in enumerate(found.boxes_xyxy) if planned is None or _lies_on(box, planned)]
        kept = [i for i in on_it if found.scores[i] >= self.threshold]
        kept = kept[: 1 if plan.role == "obstruction" else self.max_segments]
        if not kept:
            where = "" if planned is None else f" on mark {planned.mark}"
            best = f"the best of VLPart's boxes{where} scores {found.scores[on_it[0]]:.2f}" if on_it else ""
            reason = f"{best}, below {self.threshold:g}" if best else f"VLPart has no box{where}"
            return Segmentation((), (*degraded, Degradation("segment", f"{name!r}: {reason}", "no segment")))
        masks = self._masks(scene, found.boxes_xyxy[kept], planned)
        for fallback in sorted({m.fallback for m in masks if m.fallback}):
            degraded.append(Degradation("segment", "no model that turns boxes into masks (SAM) is set", fallback))
        segments = [
            _segment(mask, plan.target.strip(), float(found.scores[i]))
            for i, mask in zip(kept, masks, strict=True)
            if mask.mask.any()
        ]
        if len(segments) < len(kept):
            reason = f"{len(kept) - len(segments)} of {len(kept)} boxes got an empty mask"
            degraded.append(Degradation("segment", reason, "they are left out"))
        return Segmentation(tuple(segments), tuple(degraded))

    def _masks(self, scene: Scene, boxes_xyxy: NDArray[np.float32], planned: Proposal | None) -> list[BoxMask]:
        if self.masker is not None:
            return model_masks(self.masker, scene, boxes_xyxy, FILL_PX)
        return [scene_mask(scene, box, planned) for box in boxes_xyxy]


def _shared_sam(model: str | Path, device: str | None) -> MaskModel:
    from thinkgrasp.segmenters.segment_anything import SegmentAnything

    return SegmentAnything.shared(model, device=device)


def part_name(target: str, kind: PlanKind = "part") -> str:
    """Return a plan's target as VLPart's vocabularies write it: "object:part" or "object".

    "mug: handle", "the handle of the mug" -> "mug:handle"; a whole object's name keeps its "of".
    """
    name = re.sub(r"\s*:\s*", ":", " ".join(target.split())).strip(":")
    name = re.sub(r"^(the|a|an) ", "", name, flags=re.IGNORECASE)
    of = re.fullmatch(r"([^:]+?) of (?:(?:the|a|an) )?([^:]+)", name, flags=re.IGNORECASE)
    return f"{of[2]}:{of[1]}" if of and kind == "part" else name


def _lies_on(box_xyxy: NDArray[np.float32], proposal: Proposal) -> bool:
    x0, y0, x1, y1 = proposal.box_xyxy
    shared = np.minimum(box_xyxy[2:], [x1, y1]) - np.maximum(box_xyxy[:2], [x0, y0])
    area = float(np.prod(box_xyxy[2:] - box_xyxy[:2]))
    return bool((shared > 0).all()) and float(np.prod(shared)) >= INSIDE * area


def _segment(found: BoxMask, label: str, score: float) -> Segment:
    x0, y0, x1, y1 = box = _tight(found.mask)
    height, width = found.mask.shape
    return Segment(label, score, found.mask, box, x0 == 0 or y0 == 0 or x1 == width or y1 == height, found.mark)


def _tight(mask: Mask) -> tuple[int, int, int, int]:
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1
