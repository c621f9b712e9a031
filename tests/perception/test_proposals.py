"""What a proposal says of a thing: mask, box, size, pose, colour and shape, against rendered solids of known size."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from fakes.tables import BLUE, GREEN, ORANGE, PURPLE, RED, WHITE, YELLOW, lying, matches, perceive, view

from thinkgrasp.sim import tabletop as t
from thinkgrasp.types import Proposal, Scene

SIZE_TOLERANCE_M = 0.012


@cache
def things() -> tuple[t.Rendering, Scene]:
    """Eight things apart from one another, seen obliquely."""
    rendering = view(
        t.box("box", (0.10, 0.07, 0.12), RED, t.pose(-0.17, 0.10, 0, 0.6)),
        t.can("can", 0.034, 0.10, BLUE, t.pose(0.0, 0.12)),
        t.ball("ball", 0.035, PURPLE, t.pose(0.16, 0.10)),
        t.bowl("bowl", 0.075, 0.05, GREEN, t.pose(-0.17, -0.08)),
        t.marker("marker", ORANGE, t.pose(0.0, -0.14, 0, 0.3)),
        t.box("book", (0.13, 0.09, 0.015), BLUE, t.pose(0.16, -0.09, 0, -0.3)),
        t.can("bottle", 0.028, 0.15, YELLOW, lying(-0.02, 0.0, 0.028, 0.2)),
        t.mug("mug", 0.04, 0.09, WHITE, t.pose(0.27, 0.0, 0, -2.2)),
        eye=(0.0, -0.52, 0.50),
    )
    return rendering, perceive(rendering)


def of(name: str) -> Proposal:
    """Return the proposal that covers a thing."""
    rendering, scene = things()
    proposal, iou = matches(scene, rendering)[NAMES.index(name)]
    assert iou > 0.7, f"{name} was not found"
    return proposal


NAMES = ("box", "can", "ball", "bowl", "marker", "book", "bottle", "mug")


def test_every_thing_is_one_proposal_and_there_are_no_others() -> None:
    rendering, scene = things()
    pairs = matches(scene, rendering)
    assert min(iou for _, iou in pairs) > 0.7
    assert np.median([iou for _, iou in pairs]) > 0.85
    assert sorted(p.mark for p, _ in pairs) == [p.mark for p in scene.proposals]


@pytest.mark.parametrize(
    ("name", "size"),
    [
        ("box", (0.12, 0.10, 0.07)),
        ("can", (0.10, 0.068, 0.068)),
        ("ball", (0.07, 0.07, 0.07)),
        ("bowl", (0.14, 0.14, 0.05)),
        ("marker", (0.12, 0.019, 0.019)),
        ("book", (0.13, 0.09, 0.015)),
        ("bottle", (0.15, 0.056, 0.056)),
    ],
)
def test_extents_are_those_of_the_whole_thing(name: str, size: tuple[float, float, float]) -> None:
    """The back that one view does not show is completed."""
    np.testing.assert_allclose(of(name).extents_m, size, atol=SIZE_TOLERANCE_M)


@pytest.mark.parametrize(
    ("name", "middle"),
    [
        ("box", (-0.17, 0.10, 0.06)),
        ("can", (0.0, 0.12, 0.05)),
        ("ball", (0.16, 0.10, 0.035)),
        ("bowl", (-0.17, -0.08, 0.025)),
    ],
)
def test_centre_is_that_of_the_whole_thing(name: str, middle: tuple[float, float, float]) -> None:
    rendering, _ = things()
    T = rendering.frame.T_world_camera
    assert T is not None
    np.testing.assert_allclose(T[:3, :3] @ of(name).center_m + T[:3, 3], middle, atol=0.01)


def test_axes_are_right_handed_belong_to_the_extents_and_one_is_up() -> None:
    _, scene = things()
    assert scene.support is not None
    for p in scene.proposals:
        R = p.T_camera_object[:3, :3]
        np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-9)
        assert np.linalg.det(R) == pytest.approx(1.0)
        np.testing.assert_array_equal(p.T_camera_object[3], [0, 0, 0, 1])
        assert np.abs(scene.support.normal @ R).max() == pytest.approx(1.0, abs=1e-6)
        assert list(p.extents_m) == sorted(p.extents_m, reverse=True)
    long = of("bottle").T_camera_object[:3, 0]
    rendering, _ = things()
    T = rendering.frame.T_world_camera
    assert T is not None
    assert abs((T[:3, :3] @ long) @ [np.cos(0.2), np.sin(0.2), 0]) > 0.99


@pytest.mark.parametrize(
    ("name", "shape", "others"),
    [
        ("box", {"box-like"}, {"round", "cylindrical", "flat", "elongated", "hollow"}),
        ("can", {"cylindrical"}, {"box-like", "flat", "hollow"}),
        ("ball", {"round"}, {"box-like", "flat", "elongated", "hollow"}),
        ("bowl", {"round", "hollow"}, {"box-like", "elongated"}),
        ("marker", {"cylindrical", "elongated"}, {"hollow"}),
        ("book", {"flat", "box-like"}, {"round", "cylindrical", "hollow", "elongated"}),
        ("bottle", {"cylindrical", "elongated"}, {"box-like", "flat", "hollow"}),
        ("mug", {"cylindrical", "hollow"}, {"box-like", "flat", "elongated"}),
    ],
)
def test_shape_descriptors(name: str, shape: set[str], others: set[str]) -> None:
    degrees = dict(of(name).shapes)
    assert all(degrees.get(s, 0.0) >= 0.5 for s in shape), degrees
    assert all(degrees.get(s, 0.0) < 0.5 for s in others), degrees


@pytest.mark.parametrize(
    ("name", "color"),
    [
        ("box", "red"), ("can", "blue"), ("ball", "purple"), ("bowl", "green"), ("marker", "orange"), ("book", "blue"),
        ("bottle", "yellow"), ("mug", "white"),
    ],
)  # fmt: skip
def test_colours(name: str, color: str) -> None:
    colors = of(name).colors
    assert dict(colors).get(color, 0.0) > 0.45, colors


@pytest.mark.parametrize(
    ("name", "top"), [("box", 0.12), ("can", 0.10), ("ball", 0.07), ("bowl", 0.05), ("book", 0.015)]
)
def test_height_reaches_the_top(name: str, top: float) -> None:
    low, high = of(name).height_m
    assert low <= high
    assert high == pytest.approx(top, abs=0.008)


def test_marks_are_numbered_in_reading_order() -> None:
    _, scene = things()
    assert [p.mark for p in scene.proposals] == list(range(1, len(scene.proposals) + 1))
    middles = [((p.box_xyxy[1] + p.box_xyxy[3]) / 2, (p.box_xyxy[0] + p.box_xyxy[2]) / 2) for p in scene.proposals]
    assert middles == sorted(middles)


def test_masks_are_disjoint_and_boxes_are_tight_and_half_open() -> None:
    rendering, scene = things()
    masks = np.stack([p.mask for p in scene.proposals])
    assert masks.dtype == np.bool_
    assert masks.sum(axis=0).max() == 1
    assert masks.shape[1:] == rendering.labels.shape
    for p in scene.proposals:
        x0, y0, x1, y1 = p.box_xyxy
        assert p.mask[y0:y1, x0:x1].sum() == p.mask.sum()
        for edge in (p.mask[y0, x0:x1], p.mask[y1 - 1, x0:x1], p.mask[y0:y1, x0], p.mask[y0:y1, x1 - 1]):
            assert edge.any()


def test_whole_compact_things_are_believed() -> None:
    _, scene = things()
    assert all(0 <= p.confidence <= 1 for p in scene.proposals)
    assert not any(p.touches_border for p in scene.proposals)
    assert min(of(name).confidence for name in ("box", "can", "ball", "bowl")) > 0.7


def test_the_same_frame_gives_the_same_proposals_and_is_not_changed() -> None:
    rendering, first = things()
    color, depth = rendering.frame.color.copy(), rendering.frame.depth.copy()
    second = perceive(rendering)
    np.testing.assert_array_equal(rendering.frame.color, color)
    np.testing.assert_array_equal(rendering.frame.depth, depth)
    assert first.obstructions == second.obstructions
    for a, b in zip(first.proposals, second.proposals, strict=True):
        np.testing.assert_array_equal(a.mask, b.mask)
        np.testing.assert_array_equal(a.T_camera_object, b.T_camera_object)
        assert (a.extents_m, a.colors, a.shapes, a.confidence) == (b.extents_m, b.colors, b.shapes, b.confidence)


def test_things_cut_by_the_image_border_are_found_and_said_to_be() -> None:
    rendering = view(
        t.can("left", 0.034, 0.10, BLUE, t.pose(-0.365, 0.0)), t.ball("inside", 0.035, PURPLE, t.pose(0, 0.05))
    )
    (left, iou), (inside, _) = matches(perceive(rendering), rendering)
    assert iou > 0.7
    assert left.touches_border
    assert left.box_xyxy[0] == 0
    assert not inside.touches_border
    assert left.confidence < inside.confidence


def test_things_cut_by_the_lower_border_are_whole() -> None:
    rendering = view(t.box("near", (0.10, 0.07, 0.05), RED, t.pose(0.02, -0.27)))
    ((near, iou),) = matches(perceive(rendering), rendering)
    assert iou > 0.85
    assert near.touches_border
    assert near.box_xyxy[3] == 480
