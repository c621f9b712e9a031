"""What a model's plan has to agree with: the image that it saw, the things in the scene, and what was tried before."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from thinkgrasp.errors import ThinkGraspError
from thinkgrasp.language.grounding import MIN_SCORE, ground, plain_names
from thinkgrasp.language.query import parse
from thinkgrasp.memory import Memory
from thinkgrasp.planners.cells import Outline, choose_cell
from thinkgrasp.planners.clearing import way_to
from thinkgrasp.types import BoxXYXY, Plan, Proposal, Scene

SAME_BOX = 0.5
"""Intersection over union from which on a box is taken to be one thing's box."""
SOME_OVERLAP = 0.1
"""Least intersection over union by which a box alone tells a thing."""
NEAR_PX = 8
"""So far beside a thing a pixel may lie that is said to be on it."""
MAX_NAME, MAX_RATIONALE = 200, 2000


class UnsupportedPlan(ThinkGraspError):
    """A plan does not agree with the scene; the message tells a model what to mend."""


def check_box(plan: Plan, image_wh: tuple[int, int]) -> None:
    """Raise UnsupportedPlan unless a plan's box lies inside the image that the model saw, of this size [px]."""
    if plan.crop_xyxy is None:
        return
    x0, y0, x1, y1 = plan.crop_xyxy
    w, h = image_wh
    if not (0 <= x0 < x1 <= w and 0 <= y0 < y1 <= h):
        raise UnsupportedPlan(f"the box {plan.crop_xyxy} does not lie inside the image of {w} x {h} pixels")


def on_scene(plan: Plan, scene: Scene, memory: Memory) -> Plan:
    """Return a plan that holds for a scene, with the mark of the thing that it is about.

    Args:
        plan: With its box in the frame's pixels.
        scene: Without proposals nothing but the image speaks for a plan, and any named target is accepted.
        memory: A thing that was tried too often is no choice while there are others.

    Raises:
        UnsupportedPlan: The plan names no target, a mark that does not exist, nothing that is in the scene, or a
            thing that failed.
    """
    plan = _tidy(plan, scene)
    if not plan.found:
        return replace(plan, mark=None)
    if not scene.proposals:
        if not plan.target:
            raise UnsupportedPlan("it names no target")
        return replace(plan, mark=None)
    thing = _supporting(plan, scene)
    if memory.is_worn_out(thing) and not all(memory.is_worn_out(p) for p in scene.proposals):
        raise UnsupportedPlan(
            f"taking {plan.target or 'it'} (mark {thing.mark}) was tried and failed; choose what is in its way, or "
            "another thing"
        )
    return replace(plan, mark=thing.mark, target=plan.target or plain_names(scene)[thing.mark])


def freed(plan: Plan, scene: Scene, memory: Memory) -> Plan:
    """Return the plan for what has to go before the plan's thing, where depth shows that something has to."""
    if not plan.found or plan.mark is None:
        return plan
    worn_out = {p.mark for p in scene.proposals if memory.is_worn_out(p)}
    way = way_to(scene, plan.mark, worn_out)
    if way.first == plan.mark:
        return plan
    thing = scene.proposal(way.first)
    names = plain_names(scene)
    failed = [a.cell for a in memory.failures_at(thing)]
    cell = choose_cell(Outline.of(scene, thing), thing, plan.grid, failed=failed).cell
    steps = "; ".join(f"mark {e.a} ({names[e.a]}) {e.relation.replace('_', ' ')} mark {e.b}" for e in way.edges)
    return replace(
        plan,
        target=names[way.first],
        rationale=f"{plan.rationale} But depth shows that {steps}; so mark {way.first} goes first.",
        role="obstruction",
        kind="object",
        mark=way.first,
        cell=cell,
        crop_xyxy=None,
    )


def _tidy(plan: Plan, scene: Scene) -> Plan:
    """Return the plan with text and lists within bounds, and the box inside the frame."""
    h, w = scene.frame.depth.shape
    box = plan.crop_xyxy
    if box is not None:
        x0, y0, x1, y1 = max(box[0], 0), max(box[1], 0), min(box[2], w), min(box[3], h)
        box = (x0, y0, x1, y1) if x0 < x1 and y0 < y1 else None
    objects = tuple(
        replace(
            o,
            grasp_score=min(max(o.grasp_score, 0.0), 100.0),
            cell=o.cell if o.cell is not None and 1 <= o.cell <= plan.grid**2 else None,
        )
        for o in plan.objects
    )
    return replace(
        plan,
        target=_line(plan.target, MAX_NAME),
        rationale=_line(plan.rationale, MAX_RATIONALE) or "the model gave no reason",
        crop_xyxy=box,
        objects=objects,
    )


def _line(text: str, most: int) -> str:
    return "".join(c if c.isprintable() else " " for c in text).strip()[:most]


def _supporting(plan: Plan, scene: Scene) -> Proposal:
    """Return the thing that a plan is about: by its mark, else by its pixel, its box, or its words."""
    marks = [p.mark for p in scene.proposals]
    if plan.mark is not None:
        if plan.mark not in marks:
            raise UnsupportedPlan(f"mark {plan.mark} does not exist; the marks are {', '.join(map(str, marks))}")
        return scene.proposal(plan.mark)
    if plan.point_px is not None:
        return _at(plan.point_px, scene)
    by_words = [m.mark for m in ground(scene, parse(plan.target)).fitting(MIN_SCORE)] if plan.target else []
    if plan.crop_xyxy is not None:
        box = plan.crop_xyxy
        overlaps = {p.mark: _overlap(box, p.box_xyxy) for p in scene.proposals}
        best = max(marks, key=lambda m: overlaps[m])
        if overlaps[best] >= SAME_BOX:
            return scene.proposal(best)
        inside = {p.mark for p in scene.proposals if _holds_center(box, p.box_xyxy)}
        named = next((m for m in by_words if m in inside), None)
        if named is not None or overlaps[best] >= SOME_OVERLAP:
            return scene.proposal(named if named is not None else best)
    if by_words:
        return scene.proposal(by_words[0])
    raise UnsupportedPlan(f"nothing in the scene answers to {plan.target!r} or lies where the reply says it does")


def _at(point_px: tuple[int, int], scene: Scene) -> Proposal:
    """Return the thing with the pixel nearest to a point."""
    u, v = point_px
    distances: list[tuple[float, int]] = []
    for p in scene.proposals:
        rows, columns = np.nonzero(p.mask)
        if len(rows):
            distances.append((float(np.hypot(rows - v, columns - u).min()), p.mark))
    distance, mark = min(distances, default=(np.inf, 0))
    if distance > NEAR_PX:
        raise UnsupportedPlan("nothing that can be taken is seen at the grasp pixel; name one on the thing itself")
    return scene.proposal(mark)


def _overlap(a: BoxXYXY, b: BoxXYXY) -> float:
    """Intersection over union."""
    w, h = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    shared = max(w, 0) * max(h, 0)
    area = (a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1])
    return shared / max(area - shared, 1)


def _holds_center(box: BoxXYXY, other: BoxXYXY) -> bool:
    u, v = (other[0] + other[2]) / 2, (other[1] + other[3]) / 2
    return box[0] <= u < box[2] and box[1] <= v < box[3]
