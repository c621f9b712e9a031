"""A plan that names a proposal by its mark needs no text: its mask is there already, and can be made finer."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thinkgrasp.segmenters.boxes import mask_iou, segment_of
from thinkgrasp.types import Degradation, Plan, Proposal, Scene, Segment, Segmentation

if TYPE_CHECKING:
    from thinkgrasp.segmenters.segment_anything import MasksFromBoxes

MIN_AGREEMENT = 0.5
"""A finer mask that overlaps the proposal's less than this (IoU) is of something else."""


def marked_segment(scene: Scene, plan: Plan, refiner: MasksFromBoxes | None) -> Segmentation:
    """Return the planned proposal alone, with its own mask or the one that `refiner` finds in its box.

    Raises:
        ContractError: The plan's mark is not in the scene.
    """
    proposal = scene.proposal(plan.mark or 0)
    degraded: list[Degradation] = []
    if plan.kind == "part":
        reason = f"no part of {plan.target!r} is looked for where a mark is planned"
        degraded.append(Degradation("segment", reason, "the object's mask; the grid cell picks the part"))
    segment = Segment(plan.target, 1.0, proposal.mask, proposal.box_xyxy, proposal.touches_border, proposal.mark)
    if refiner is not None:
        segment, note = _refined(scene, proposal, segment, refiner)
        degraded += note
    if not segment.mask.any():
        return Segmentation((), tuple(degraded))
    return Segmentation((segment,), tuple(degraded))


def _refined(
    scene: Scene, proposal: Proposal, segment: Segment, refiner: MasksFromBoxes
) -> tuple[Segment, list[Degradation]]:
    mask = refiner.masks(scene.frame.color, np.array([proposal.box_xyxy], np.float32)).masks[0]
    agreement = mask_iou(mask, proposal.mask)
    if agreement < MIN_AGREEMENT:
        reason = f"the finer mask of mark {proposal.mark} agrees with the proposal's by {agreement:.2f} only (IoU)"
        return segment, [Degradation("segment", reason, "the proposal's own mask")]
    return segment_of(mask, segment.label, 1.0, proposal.mark), []
