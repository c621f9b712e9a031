"""The obstruction graph: who hides, carries or walls in whom, with evidence in metres or pixels."""

from __future__ import annotations

import pytest
from fakes.tables import BLUE, GREEN, PURPLE, RED, YELLOW, matches, perceive, view

from thinkgrasp.perception.obstruction import FINGER_ROOM_M, MIN_HIDING_PX
from thinkgrasp.sim import tabletop as t
from thinkgrasp.types import Obstruction, Relation, Scene


def related(rendering: t.Rendering) -> tuple[Scene, list[int]]:
    """Perceive, and return the scene with the mark of each object in order."""
    scene = perceive(rendering)
    pairs = matches(scene, rendering)
    assert min(iou for _, iou in pairs) > 0.6, [iou for _, iou in pairs]
    marks = [p.mark for p, _ in pairs]
    assert len(set(marks)) == len(marks)
    known = {p.mark for p in scene.proposals}
    assert all(e.a in known and e.b in known and e.a != e.b for e in scene.obstructions)
    assert len({(e.relation, e.a, e.b) for e in scene.obstructions}) == len(scene.obstructions)
    return scene, marks


def edge(scene: Scene, relation: Relation, a: int, b: int) -> Obstruction | None:
    return next((e for e in scene.obstructions if (e.relation, e.a, e.b) == (relation, a, b)), None)


def test_what_stands_on_a_thing_rests_on_it() -> None:
    rendering = view(
        t.box("box", (0.12, 0.09, 0.04), RED, t.pose(0.0, 0.0)),
        t.cup("cup", 0.03, 0.08, BLUE, t.pose(0.0, 0.0, 0.04)),
        t.can("apart", 0.033, 0.10, GREEN, t.pose(0.22, 0.05)),
    )
    scene, (box, cup, apart) = related(rendering)
    rests = edge(scene, "rests_on", cup, box)
    assert rests is not None
    assert rests.unit == "m"
    assert abs(rests.evidence) < 0.02
    assert edge(scene, "rests_on", box, cup) is None
    assert cup in {e.a for e in scene.obstructing(box)}
    assert not any(apart in (e.a, e.b) for e in scene.obstructions)
    assert edge(scene, "blocks", cup, box) is None, "what rests on a thing does not stand beside it"


def test_what_lies_in_a_bowl_rests_on_it_below_the_rim() -> None:
    rendering = view(
        t.bowl("bowl", 0.085, 0.055, GREEN, t.pose(0.0, 0.0)), t.ball("ball", 0.03, PURPLE, t.pose(0.0, 0.0, 0.007))
    )
    scene, (bowl, ball) = related(rendering)
    rests = edge(scene, "rests_on", ball, bowl)
    assert rests is not None
    assert -0.06 < rests.evidence < 0.03
    assert edge(scene, "rests_on", bowl, ball) is None


def test_a_tall_thing_in_front_hides_and_is_not_hidden() -> None:
    rendering = view(
        t.box("tall", (0.09, 0.04, 0.14), RED, t.pose(0.0, -0.07)),
        t.can("behind", 0.033, 0.10, BLUE, t.pose(0.035, 0.06)),
        eye=(0.0, -0.65, 0.40),
    )
    assert 0.25 < rendering.visible_fraction[1] < 0.95
    scene, (tall, behind) = related(rendering)
    hides = edge(scene, "hides", tall, behind)
    assert hides is not None
    assert hides.unit == "px"
    assert hides.evidence >= MIN_HIDING_PX
    assert edge(scene, "hides", behind, tall) is None
    assert tall in {e.a for e in scene.obstructing(behind)}


def flanked(gap: float) -> t.Rendering:
    """A box that fits the gripper in one direction only, and there between two others with this room [m] beside it."""
    reach = 0.025 + gap + 0.03
    return view(
        t.box("middle", (0.05, 0.15, 0.09), BLUE, t.pose(0.0, 0.0)),
        t.box("left", (0.06, 0.12, 0.11), RED, t.pose(-reach, 0.0)),
        t.box("right", (0.06, 0.12, 0.11), YELLOW, t.pose(reach, 0.0)),
        eye=(0.0, -0.25, 0.7),
    )


def test_neighbours_that_leave_no_room_for_a_finger_block() -> None:
    scene, (middle, *others) = related(flanked(0.012))
    blocking = [e for e in scene.obstructions if e.relation == "blocks" and e.b == middle]
    assert blocking
    assert {e.a for e in blocking} <= set(others)
    for e in blocking:
        assert e.unit == "m"
        assert 0 <= e.evidence < FINGER_ROOM_M
    assert min(e.evidence for e in blocking) == pytest.approx(0.012, abs=0.006)


def test_neighbours_that_leave_room_do_not_block() -> None:
    scene, (middle, *_) = related(flanked(0.045))
    assert not [e for e in scene.obstructions if e.relation == "blocks" and e.b == middle]


def test_one_free_direction_is_enough() -> None:
    rendering = view(
        t.can("can", 0.025, 0.10, BLUE, t.pose(0.0, 0.0)),
        t.box("left", (0.06, 0.06, 0.09), RED, t.pose(-0.064, 0.0)),
        t.box("right", (0.06, 0.06, 0.09), YELLOW, t.pose(0.064, 0.0)),
        eye=(0.0, -0.25, 0.7),
    )
    scene, (can, *_) = related(rendering)
    assert not [e for e in scene.obstructions if e.relation == "blocks" and e.b == can]


def test_things_apart_have_no_edges() -> None:
    rendering = view(
        t.box("a", (0.06, 0.06, 0.08), RED, t.pose(-0.22, 0.0)),
        t.can("b", 0.033, 0.10, BLUE, t.pose(0.0, 0.0)),
        t.ball("c", 0.035, PURPLE, t.pose(0.22, 0.0)),
    )
    scene, _ = related(rendering)
    assert scene.obstructions == ()
