"""Things that depth does not see: they need another colour than the surface; holes and shadows do not count."""

from __future__ import annotations

import numpy as np
import pytest
from fakes.tables import BLUE, CHAIR, DESK, GREEN, PURPLE, RED, matches, overlap, perceive, pinhole, view, without_pose

from thinkgrasp.perception import GeometricPerception
from thinkgrasp.sim import tabletop as t
from thinkgrasp.types import Frame, Mask

CAN = t.can("can", 0.034, 0.10, BLUE, t.pose(-0.14, 0.0))


def blinded(rendering: t.Rendering, where: Mask) -> Frame:
    """Return the frame with no depth in an area, as behind clear or shiny things."""
    depth = np.where(where, np.float32(0), rendering.frame.depth)
    return Frame(rendering.frame.color, depth, rendering.frame.camera, None)


def test_a_thing_without_any_depth_is_proposed_by_its_colour_and_sized_where_it_stands() -> None:
    rendering = view(CAN, t.can("clear", 0.03, 0.09, GREEN, t.pose(0.10, 0.0)))
    scene = GeometricPerception().perceive(blinded(rendering, rendering.mask(1)))
    (_, iou), (clear, clear_iou) = matches(scene, rendering)
    assert iou > 0.7
    assert clear_iou > 0.6
    assert clear.colors[0][0] == "green"
    assert 0.06 < max(clear.extents_m) < 0.15, (
        "an upright card as high as the silhouette: an upper bound of 0.09 + depth"
    )
    T = rendering.frame.T_world_camera
    assert T is not None
    np.testing.assert_allclose((T[:3, :3] @ clear.center_m + T[:3, 3])[:2], [0.10, -0.02], atol=0.025)
    np.testing.assert_array_equal(np.isfinite(scene.points[..., 2]), blinded(rendering, rendering.mask(1)).depth > 0)


def test_a_thing_without_any_depth_is_believed_less() -> None:
    rendering = view(CAN)
    unseen = GeometricPerception().perceive(blinded(rendering, rendering.mask(0))).proposals
    assert len(unseen) == 1
    assert unseen[0].confidence < perceive(rendering).proposals[0].confidence - 0.15


@pytest.mark.parametrize("side", [20, 45])
def test_a_hole_in_the_colour_of_the_table_is_no_thing(side: int) -> None:
    rendering = view(CAN)
    hole = np.zeros(rendering.labels.shape, bool)
    hole[260 - side : 260 + side, 400 - side : 400 + side] = True
    scene = GeometricPerception().perceive(blinded(rendering, hole))
    assert len(scene.proposals) == 1
    assert not (scene.proposals[0].mask & hole).any()


def test_a_coloured_card_that_lies_flat_is_proposed() -> None:
    rendering = view(CAN, t.box("card", (0.085, 0.054, 0.0008), RED, t.pose(0.08, 0.0, 0, 0.3)))
    _, (card, iou) = matches(perceive(rendering), rendering)
    assert iou > 0.75
    assert card.colors[0][0] == "red"
    assert card.shape_degree("flat") > 0.5
    assert card.extents_m[0] == pytest.approx(0.085, abs=0.012)
    assert card.extents_m[1] == pytest.approx(0.054, abs=0.012)
    assert card.extents_m[2] < 0.008


@pytest.mark.parametrize("table", [(208, 206, 200), (70, 130, 128)], ids=["white", "teal"])
def test_shadows_are_no_things(table: tuple[int, int, int]) -> None:
    things = (
        t.ball("ball", 0.035, PURPLE, t.pose(0.10, 0.05)),
        t.box("tall", (0.06, 0.06, 0.18), RED, t.pose(-0.10, 0.08, 0, 0.4)),
        t.can("can", 0.033, 0.10, BLUE, t.pose(0.02, -0.08)),
    )
    layout = t.TabletopScene(things, table_color=table)
    rendering = t.render(layout, pinhole(640, 480), t.look_at((0.0, -0.5, 0.5), (0.0, 0.0, 0.03)))
    scene = perceive(rendering)
    best = [max(overlap(p.mask, rendering.mask(i)) for i in range(3)) for p in scene.proposals]
    assert len(best) == 3, [p.colors for p in scene.proposals]
    assert min(best) > 0.6


def test_what_lies_beside_the_table_is_no_thing() -> None:
    """Floor, desk and chair have another colour than the table, and partly no depth."""
    rendering = view(CAN, eye=(0.1, -0.85, 0.62), table_m=(0.55, 0.5), background=(DESK, CHAIR))
    scene = GeometricPerception().perceive(without_pose(rendering.frame))
    assert len(scene.proposals) == 1
    off = rendering.frame.depth > 0
    off[240:] = False
    scene = GeometricPerception().perceive(blinded(rendering, ~off & (np.arange(480) < 60)[:, None]))
    assert len(scene.proposals) == 1
