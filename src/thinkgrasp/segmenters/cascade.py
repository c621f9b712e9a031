"""The paper's rule for masks, with its fallbacks written out: each step that is taken is said."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from thinkgrasp import registry
from thinkgrasp.errors import ConfigError
from thinkgrasp.interfaces import Segmenter
from thinkgrasp.segmenters.crops import cut_scene, put_back, sharpness, widened
from thinkgrasp.segmenters.names import other_names, whole_and_part
from thinkgrasp.types import Degradation, Frame, Plan, Scene, Segment, Segmentation

MIN_ON_OBJECT = 0.5
"""At least this share of a part lies on the object it belongs to."""
_GRID_PICKS = "the object; the grid cell picks the part"

Choice = str | Mapping[str, object] | Segmenter
"""A plug-in's name, {"name": ..., "settings": {...}}, or the segmenter itself."""


@dataclass(frozen=True)
class _Stage:
    """A segmenter and what it is called in `degraded`."""

    name: str
    segmenter: Segmenter


@dataclass(frozen=True)
class _Answer:
    """What became of one question: segments, or why there are none; and what the segmenter said of itself."""

    segments: tuple[Segment, ...]
    notes: tuple[Degradation, ...] = ()
    problem: str = ""


class CascadeSegmenter:
    """Ask a segmenter of objects, or of parts where the image allows it, and fall back step by step.

    Objects: the plan's name, then its head noun, then what else the planner considered, then the geometric proposals.
    Parts: the part in the whole image, then in the crop of its object, then the object, where the grid cell picks the
    part. A planned mark stands for its object, and a part of it is looked for in its crop alone. All masks that
    answer are returned, best first.

    Args:
        objects: Segmenter of objects.
        parts: Segmenter of parts; None = there is none.
        proposals: Segmenter that answers from the scene's proposals.
        min_side_px: Parts are looked for in images whose shorter side is at least so long ...
        min_sharpness: ... and that are at least so sharp (see `crops.sharpness`); 0 = any.
        crop_then_prompt: Look for a part in its object's crop.
        crop_margin: The crop is wider than the object by this share of its sides, at each side.
        max_alternatives: So many of the planner's other objects are asked for.
        border_score: What the image's border cuts has to score at least this; 0 = like everything else.
        max_share: A mask that covers more of the image than this is of the scene and of no thing in it.

    Raises:
        ConfigError: A setting is out of range, or one of the segmenters cannot be made.
    """

    def __init__(
        self,
        *,
        objects: Choice = "grounded_sam",
        parts: Choice | None = "vlpart",
        proposals: Choice = "geometric",
        min_side_px: int = 400,
        min_sharpness: float = 5.0,
        crop_then_prompt: bool = True,
        crop_margin: float = 0.1,
        max_alternatives: int = 3,
        border_score: float = 0.5,
        max_share: float = 0.9,
    ) -> None:
        numbers = {
            "min_side_px": min_side_px,
            "min_sharpness": min_sharpness,
            "crop_margin": crop_margin,
            "max_alternatives": max_alternatives,
        }
        for name, value in numbers.items():
            if not (np.isfinite(value) and value >= 0):
                raise ConfigError(f"cascade segmenter: {name} must be at least 0, got {value}")
        if not 0 <= border_score <= 1:
            raise ConfigError(f"cascade segmenter: border_score must lie in [0, 1], got {border_score}")
        if not 0 < max_share <= 1:
            raise ConfigError(f"cascade segmenter: max_share must lie in (0, 1], got {max_share}")
        self.objects = _stage("objects", objects)
        self.parts = None if parts is None else _stage("parts", parts, "; or set parts=null to do without")
        self.proposals = _stage("proposals", proposals)
        self.min_side_px = min_side_px
        self.min_sharpness = min_sharpness
        self.crop_then_prompt = crop_then_prompt
        self.crop_margin = crop_margin
        self.max_alternatives = max_alternatives
        self.border_score = border_score
        self.max_share = max_share

    def segment(self, scene: Scene, plan: Plan) -> Segmentation:
        """Return all masks that answer to the plan, best first; every fallback is in `degraded`.

        Raises:
            ContractError: The plan's mark is not in the scene.
        """
        if plan.mark is not None:
            scene.proposal(plan.mark)
        answer = self._part(scene, plan) if plan.kind == "part" else self._object(scene, plan)
        segments = sorted(answer.segments, key=lambda s: -s.score)
        return Segmentation(tuple(segments), answer.notes)

    def _object(self, scene: Scene, plan: Plan) -> _Answer:
        """Ask for the planned mark, or for one name after the other; then the proposals."""
        names = (plan.target,)
        if plan.mark is None:
            names += other_names(plan.target, plan.objects, self.max_alternatives)
        notes: list[Degradation] = []
        for name, following in zip(names, [*(repr(n) for n in names[1:]), "the geometric proposals"], strict=True):
            answer = self._ask(self.objects, scene, replace(plan, target=name, kind="object"))
            if answer.segments:
                return _Answer(answer.segments, (*notes, *answer.notes))
            notes.append(Degradation("segment", answer.problem, following))
        answer = self._ask(self.proposals, scene, replace(plan, kind="object"))
        said = answer.notes or ((Degradation("segment", answer.problem, "no segment"),) if answer.problem else ())
        return _Answer(answer.segments, (*notes, *said))

    def _part(self, scene: Scene, plan: Plan) -> _Answer:
        whole, part = whole_and_part(plan.target)
        problem = self._unfit(scene.frame) if part is not None else f"{plan.target!r} names no part"
        if self.parts is None or problem:
            notes = (Degradation("segment", problem or "there is no segmenter of parts", _GRID_PICKS),)
            return self._with(notes, self._object(scene, replace(plan, target=whole)))
        notes = ()
        if plan.mark is None:
            answer = self._ask(self.parts, scene, plan)
            if answer.segments:
                return answer
            following = "its object, and the part in its crop" if self.crop_then_prompt else _GRID_PICKS
            notes = (Degradation("segment", answer.problem, following),)
        found = self._with(notes, self._object(scene, replace(plan, target=whole)))
        if not found.segments:
            return found
        if not self.crop_then_prompt:
            asked = plan.mark is None
            note = Degradation("segment", "no part of a mark is looked for where crop_then_prompt is off", _GRID_PICKS)
            return found if asked else replace(found, notes=(*found.notes, note))
        return self._part_in_crop(self.parts, scene, plan, found)

    def _part_in_crop(self, parts: _Stage, scene: Scene, plan: Plan, found: _Answer) -> _Answer:
        """Look for the part in the crop of the best object; else return what was found."""
        owner = max(found.segments, key=lambda s: s.score)
        hw = (owner.mask.shape[0], owner.mask.shape[1])
        box = widened(owner.box_xyxy, self.crop_margin, hw)
        answer = self._ask(parts, cut_scene(scene, box), replace(plan, mark=None), crop=True)
        back = [put_back(segment, box, hw) for segment in answer.segments]
        on_it = tuple(s for s in back if np.count_nonzero(s.mask & owner.mask) >= MIN_ON_OBJECT * s.mask.sum())
        if on_it:
            return _Answer(on_it, (*found.notes, *answer.notes))
        off = f"{parts.name} finds {plan.target!r} beside its object only"
        note = Degradation("segment", off if back else f"{answer.problem} in the crop of {owner.label!r}", _GRID_PICKS)
        return _Answer(found.segments, (*found.notes, note))

    def _ask(self, stage: _Stage, scene: Scene, plan: Plan, *, crop: bool = False) -> _Answer:
        """Ask one segmenter; what it raises is a problem like any other, and so is a mask of nothing or of everything.

        What the border cuts has to score more. In a crop a part may fill the view and be cut.
        """
        try:
            result = stage.segmenter.segment(scene, plan)
        except Exception as error:  # a network may fail in many ways, and none of them is a reason to stop the robot
            reason = (str(error).strip().splitlines() or [""])[0]
            return _Answer((), (), f"{stage.name} failed ({type(error).__name__}: {reason})")
        kept: list[Segment] = []
        left = Counter[str]()
        for segment in result.segments:
            flaw = self._flaw(segment, crop=crop)
            if flaw:
                left[flaw] += 1
            else:
                kept.append(segment)
        faulty = " and ".join(f"{count} {flaw}" for flaw, count in left.items())
        if not kept:
            problem = f"{stage.name} finds no {plan.target!r}" + (f" but {faulty}" if faulty else "")
            return _Answer((), result.degraded, problem)
        if not faulty:
            return _Answer(tuple(kept), result.degraded)
        note = Degradation("segment", f"of what {stage.name} finds for {plan.target!r}, {faulty}", "left out")
        return _Answer(tuple(kept), (*result.degraded, note))

    def _flaw(self, segment: Segment, *, crop: bool) -> str:
        """Return why a segment does not count; empty where it does."""
        if not segment.mask.any():
            return "with an empty mask"
        if not crop and segment.mask.mean() > self.max_share:
            return f"covering more than {self.max_share:.0%} of the image"
        if not crop and segment.touches_border and segment.score < self.border_score:
            return f"cut by the border, scoring less than {self.border_score:g}"
        return ""

    def _unfit(self, frame: Frame) -> str:
        """Return why parts cannot be told apart in this image; empty where they can."""
        side = min(frame.depth.shape)
        if side < self.min_side_px:
            return f"the image's shorter side is {side} px, parts need {self.min_side_px}"
        if self.min_sharpness > 0 and (sharp := sharpness(frame.color)) < self.min_sharpness:
            return f"the image's sharpness is {sharp:.1f}, parts need {self.min_sharpness:g}"
        return ""

    @staticmethod
    def _with(notes: tuple[Degradation, ...], answer: _Answer) -> _Answer:
        return replace(answer, notes=(*notes, *answer.notes))


def _stage(role: str, choice: Choice, otherwise: str = "") -> _Stage:
    name, settings = _named(role, choice)
    if name is None:
        return _Stage(type(choice).__name__, cast(Segmenter, choice))
    try:
        return _Stage(name, registry.load("segmenter", name, **settings))
    except (ConfigError, ValueError) as error:
        raise ConfigError(f"cascade segmenter: {role}: {error}{otherwise}") from error


def _named(role: str, choice: Choice) -> tuple[str | None, dict[str, Any]]:
    """Return a plug-in's name and settings; the name is None where the segmenter itself is given."""
    if isinstance(choice, str):
        return choice, {}
    if isinstance(choice, Mapping):
        name, settings = choice.get("name"), choice.get("settings", {})
        if isinstance(name, str) and isinstance(settings, Mapping) and set(choice) <= {"name", "settings"}:
            return name, dict(cast(Mapping[str, Any], settings))
    elif isinstance(choice, Segmenter):
        return None, {}
    raise ConfigError(
        f'cascade segmenter: {role} must be a plug-in name, {{"name": ..., "settings": {{...}}}} or a segmenter, '
        f"got {choice!r}"
    )
