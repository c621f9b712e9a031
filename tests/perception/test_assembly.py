"""Which pixels make one thing: things that touch or stand in one another are several, hollow and printed ones one."""

from __future__ import annotations

import numpy as np
import pytest
from fakes.tables import BLACK, BLUE, GREEN, ORANGE, PURPLE, RED, WHITE, YELLOW, lying, matches, overlap, perceive, view

from thinkgrasp.perception import GeometricPerception
from thinkgrasp.sim import tabletop as t
from thinkgrasp.sim.solids import Cylinder, Paint
from thinkgrasp.types import Frame


def found(rendering: t.Rendering, at_least: float = 0.7) -> list[int]:
    """Return the mark of each object's proposal after checking that it covers the object."""
    pairs = matches(perceive(rendering), rendering)
    ious = [round(iou, 2) for _, iou in pairs]
    assert min(ious) >= at_least, ious
    return [p.mark for p, _ in pairs]


def test_things_that_touch_are_separated() -> None:
    rendering = view(
        t.box("a", (0.07, 0.07, 0.10), RED, t.pose(-0.16, 0.0, 0, 0.5)),
        t.box("b", (0.07, 0.07, 0.06), BLUE, t.pose(-0.07, 0.01, 0, -0.1)),
        t.can("c", 0.033, 0.10, GREEN, t.pose(0.05, 0.0)),
        t.can("d", 0.033, 0.10, YELLOW, t.pose(0.116, 0.0)),
        t.ball("e", 0.03, PURPLE, t.pose(0.05, -0.064)),
    )
    assert len(set(found(rendering))) == 5


@pytest.mark.xfail(strict=True, reason="faces in line look like one face with a print; the outline is not considered")
def test_boxes_of_two_colours_whose_faces_are_in_line_are_separated() -> None:
    rendering = view(
        t.box("a", (0.07, 0.07, 0.10), RED, t.pose(-0.035, 0.0)),
        t.box("b", (0.07, 0.07, 0.06), BLUE, t.pose(0.035, 0.0)),
    )
    assert len(set(found(rendering))) == 2


@pytest.mark.xfail(strict=True, reason="the fold between two equal walls is a few pixels wide and is averaged away")
def test_two_cans_of_one_colour_that_touch_are_separated() -> None:
    rendering = view(
        t.can("a", 0.033, 0.10, BLUE, t.pose(-0.033, 0.0)), t.can("b", 0.033, 0.10, BLUE, t.pose(0.033, 0.0))
    )
    assert len(set(found(rendering))) == 2


@pytest.mark.parametrize(
    ("eye", "yaw"),
    [
        pytest.param((0.0, -0.5, 0.5), -0.6, id="handle to the right"),
        pytest.param((0.0, -0.5, 0.5), -2.4, id="handle to the left"),
        pytest.param((0.0, -0.3, 0.65), -1.6, id="handle in front, from above"),
        pytest.param((0.0, -0.5, 0.5), -1.6, id="handle in front"),
    ],
)
def test_a_mug_is_one_thing_with_inside_and_handle(eye: tuple[float, float, float], yaw: float) -> None:
    rendering = view(t.mug("mug", 0.041, 0.09, WHITE, t.pose(0.0, 0.0, 0, yaw)), eye=eye)
    scene = perceive(rendering)
    assert len(scene.proposals) == 1
    assert overlap(scene.proposals[0].mask, rendering.mask(0)) > 0.85


def test_bowls_and_cups_are_one_thing() -> None:
    rendering = view(
        t.bowl("bowl", 0.08, 0.055, GREEN, t.pose(-0.12, 0.0)),
        t.cup("cup", 0.033, 0.09, BLUE, t.pose(0.12, 0.0)),
        eye=(0.0, -0.35, 0.6),
    )
    scene = perceive(rendering)
    assert len(scene.proposals) == 2
    assert min(iou for _, iou in matches(scene, rendering)) > 0.85


@pytest.mark.parametrize("paint", [PURPLE, GREEN], ids=["other colour", "same colour"])
def test_a_ball_in_a_bowl_is_two_things(paint: Paint) -> None:
    rendering = view(
        t.bowl("bowl", 0.085, 0.055, GREEN, t.pose(0.0, 0.0)), t.ball("ball", 0.028, paint, t.pose(0.0, 0.0, 0.007))
    )
    assert len(set(found(rendering))) == 2


def test_a_cup_on_a_box_is_two_things() -> None:
    rendering = view(
        t.box("box", (0.12, 0.09, 0.04), RED, t.pose(0.0, 0.0)),
        t.cup("cup", 0.03, 0.08, BLUE, t.pose(0.0, 0.0, 0.04)),
    )
    assert len(set(found(rendering))) == 2


def test_a_label_does_not_cut_a_thing() -> None:
    rendering = view(
        t.can("can", 0.034, 0.11, Paint((238, 236, 230), (196, 40, 36), (-0.02, 0.03)), t.pose(-0.10, 0.0)),
        t.box(
            "box", (0.12, 0.06, 0.15), Paint((190, 36, 34), (240, 214, 150), (-0.02, 0.04)), t.pose(0.10, 0.0, 0, 0.4)
        ),
    )
    scene = perceive(rendering)
    assert len(scene.proposals) == 2
    assert min(iou for _, iou in matches(scene, rendering)) > 0.85


def test_thin_and_flat_things_are_found() -> None:
    shaft = Cylinder(0.004, 0.11, Paint((60, 62, 66)), lying(0.055, 0.0, 0.012))
    grip = Cylinder(0.012, 0.09, ORANGE, lying(-0.045, 0.0, 0.012))
    rendering = view(
        t.TableObject("screwdriver", (shaft, grip), t.pose(-0.10, 0.02, 0, 0.7)),
        t.marker("marker", BLUE, t.pose(0.10, -0.03, 0, -0.5)),
        t.can("rod", 0.006, 0.20, BLACK, lying(0.06, 0.09, 0.006, 0.1)),
        eye=(0.0, -0.4, 0.45),
    )
    assert len(set(found(rendering, 0.55))) == 3


def punched(frame: Frame, hole: tuple[slice, slice]) -> Frame:
    depth = frame.depth.copy()
    depth[hole] = 0
    return Frame(frame.color, depth, frame.camera, None)


@pytest.mark.parametrize("across", [True, False], ids=["a strip right across", "a hole in the middle"])
def test_missing_depth_does_not_split_a_thing(across: bool) -> None:
    """A shiny band over a box from edge to edge, and a blind spot inside it."""
    rendering = view(t.box("box", (0.14, 0.06, 0.12), RED, t.pose(0.0, 0.0)))
    v, u = np.nonzero(rendering.mask(0))
    row, column = int(np.median(v)), int(np.median(u))
    wide = slice(u.min() - 5, u.max() + 5) if across else slice(column - 20, column + 20)
    frame = punched(rendering.frame, (slice(row - 7, row + 7), wide))
    scene = GeometricPerception().perceive(frame)
    assert len(scene.proposals) == 1
    assert overlap(scene.proposals[0].mask, rendering.mask(0)) > 0.85
    assert scene.proposals[0].mask[row, column], "pixels without depth inside a thing belong to it"


def test_a_fifth_of_the_depth_missing_loses_no_thing() -> None:
    rendering = view(
        t.box("box", (0.10, 0.07, 0.12), RED, t.pose(-0.14, 0.0, 0, 0.5)),
        t.can("can", 0.034, 0.10, BLUE, t.pose(0.0, 0.05)),
        t.ball("ball", 0.035, PURPLE, t.pose(0.13, 0.0)),
        dropout=0.2,
    )
    assert len(set(found(rendering))) == 3


def test_an_empty_table_has_no_things() -> None:
    for eye, size in (((0.0, -0.5, 0.5), (640, 480)), ((0.0, -0.1, 0.8), (320, 240))):
        scene = perceive(view(eye=eye, size=size))
        assert scene.support is not None
        assert scene.proposals == ()
        assert scene.obstructions == ()
