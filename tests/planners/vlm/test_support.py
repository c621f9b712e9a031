"""A plan is held against the scene: marks that exist, boxes inside, targets that something in view supports."""

from __future__ import annotations

from dataclasses import replace

import pytest

from thinkgrasp.memory import Attempt, Memory
from thinkgrasp.planners.vlm.support import UnsupportedPlan, check_box, freed, on_scene
from thinkgrasp.testing import sample_scene, strict_scene
from thinkgrasp.types import Obstruction, Outcome, Plan, PlannedObject

SCENE = sample_scene()
NONE_YET = Memory()


@pytest.mark.parametrize("box", [(-1, 0, 5, 5), (0, 0, 225, 5), (5, 5, 5, 9), (9, 9, 5, 12), (0, 200, 4, 225)])
def test_boxes_lie_inside_the_image(box):
    with pytest.raises(UnsupportedPlan, match="224 x 224"):
        check_box(Plan("a", "b", crop_xyxy=box), (224, 224))


def test_good_boxes_pass():
    check_box(Plan("a", "b"), (224, 224))
    check_box(Plan("a", "b", crop_xyxy=(0, 0, 224, 224)), (224, 224))


@pytest.mark.parametrize("mark", [0, -1, 11, 10**12])
def test_marks_exist(mark):
    with pytest.raises(UnsupportedPlan, match="the marks are 1, 2, 3, 4, 5, 6, 7, 8, 9, 10"):
        on_scene(Plan("it", "why", mark=mark), SCENE, NONE_YET)


@pytest.mark.parametrize("proposal", SCENE.proposals, ids=lambda p: str(p.mark))
def test_a_box_of_one_thing_tells_it_whatever_it_is_called(proposal):
    x0, y0, x1, y1 = proposal.box_xyxy
    plan = on_scene(Plan("thingamajig", "why", crop_xyxy=(x0 - 1, y0, x1 + 1, y1 + 1)), SCENE, NONE_YET)
    assert plan.mark == proposal.mark


def test_in_a_box_of_several_things_the_words_tell():
    everything = (0, 0, 320, 240)
    green = next(p.mark for p in SCENE.proposals if p.colors[0][0] == "green")
    assert on_scene(Plan("green", "why", crop_xyxy=everything), SCENE, NONE_YET).mark == green


@pytest.mark.parametrize(
    "plan", [Plan("unicorn", "why"), Plan("", "why"), Plan("unicorn", "w", crop_xyxy=(0, 0, 9, 9))]
)
def test_something_has_to_support_a_target(plan):
    with pytest.raises(UnsupportedPlan, match="nothing in the scene answers"):
        on_scene(plan, SCENE, NONE_YET)


def test_without_proposals_any_named_target_will_do():
    plan = on_scene(Plan("unicorn", "why", mark=7, crop_xyxy=(-5, 3, 900, 20)), strict_scene(), NONE_YET)
    assert (plan.target, plan.mark, plan.crop_xyxy) == ("unicorn", None, (0, 3, 320, 20))
    with pytest.raises(UnsupportedPlan, match="names no target"):
        on_scene(Plan(" ", "why"), strict_scene(), NONE_YET)


def test_what_is_only_told_is_put_in_order():
    listed = (PlannedObject("a", 140.0, 12), PlannedObject("b", -3.0, 2))
    plan = on_scene(Plan("a\x1b[31m" + "b" * 999, "", mark=1, objects=listed), SCENE, NONE_YET)
    assert plan.target.isprintable()
    assert len(plan.target) == 200
    assert plan.rationale == "the model gave no reason"
    assert plan.objects == (PlannedObject("a", 100.0, None), PlannedObject("b", 0.0, 2))


def test_nothing_found_is_a_plan():
    plan = on_scene(Plan("", "all are too large", mark=99, found=False), SCENE, NONE_YET)
    assert (plan.found, plan.mark) == (False, None)


def test_what_failed_is_refused_while_there_is_another_choice():
    one = SCENE.proposal(1)
    memory = Memory((Attempt("it", 5, None, one.center_m, Outcome(False, "unreachable")),))
    with pytest.raises(UnsupportedPlan, match=r"taking it \(mark 1\) was tried and failed"):
        on_scene(Plan("it", "why", mark=1), SCENE, memory)
    alone = replace(SCENE, proposals=(one,))
    assert on_scene(Plan("it", "why", mark=1), alone, memory).mark == 1


def test_the_way_is_cleared_up_to_a_free_thing():
    piled = replace(
        SCENE, obstructions=(Obstruction("rests_on", 2, 1, 9, "px"), Obstruction("rests_on", 3, 2, 9, "px"))
    )
    plan = freed(Plan("it", "why.", mark=1, cell=9, kind="part"), piled, NONE_YET)
    assert (plan.mark, plan.role, plan.kind) == (3, "obstruction", "object")
    assert plan.rationale.endswith("so mark 3 goes first.")
    free = Plan("it", "why", mark=4)
    assert freed(free, piled, NONE_YET) is free
