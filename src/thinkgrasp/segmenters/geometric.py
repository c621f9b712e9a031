"""Masks from the scene's own proposals: the planned one first, then all others that answer to the plan's text."""

from __future__ import annotations

from thinkgrasp.errors import ConfigError
from thinkgrasp.language.grounding import MIN_SCORE, ground
from thinkgrasp.language.query import parse
from thinkgrasp.types import Degradation, Plan, Proposal, Scene, Segment, Segmentation


class GeometricSegmenter:
    """Answer a plan with the proposals of the scene.

    Args:
        min_score: A proposal that answers to the plan's text less than this is left out, unless its mark is planned.
        max_segments: Keep at most this many.

    Raises:
        ConfigError: A setting is out of range.
    """

    def __init__(self, *, min_score: float = MIN_SCORE, max_segments: int = 10) -> None:
        if not 0 < min_score < 1:
            raise ConfigError(f"geometric segmenter: min_score must lie in (0, 1), got {min_score}")
        if max_segments < 1:
            raise ConfigError(f"geometric segmenter: max_segments must be at least 1, got {max_segments}")
        self.min_score = min_score
        self.max_segments = max_segments

    def segment(self, scene: Scene, plan: Plan) -> Segmentation:
        """Return the planned proposal and those that match the plan's text, best first.

        An obstruction is returned alone: what has to go is one particular thing.

        Raises:
            ContractError: The plan's mark is not in the scene.
        """
        degraded: list[Degradation] = []
        if plan.kind == "part":
            reason = f"no part of {plan.target!r} is segmented from geometry"
            degraded.append(Degradation("segment", reason, "the object's mask; the grid cell picks the part"))
        if not scene.proposals:
            reason = "no object proposals (the scene stage is off or found nothing)"
            return Segmentation((), (*degraded, Degradation("segment", reason, "no segment")))
        planned = scene.proposal(plan.mark) if plan.mark is not None else None
        if planned is not None and plan.role == "obstruction":
            return Segmentation((_segment(planned, plan.target, 1.0),), tuple(degraded))
        segments = [_segment(planned, plan.target, 1.0)] if planned is not None else []
        for match in ground(scene, parse(plan.target)).fitting(self.min_score):
            if match.mark != plan.mark:
                segments.append(_segment(scene.proposal(match.mark), match.label, match.score))
        return Segmentation(tuple(s for s in segments if s.mask.any())[: self.max_segments], tuple(degraded))


def _segment(proposal: Proposal, label: str, score: float) -> Segment:
    return Segment(label, score, proposal.mask, proposal.box_xyxy, proposal.touches_border, proposal.mark)
