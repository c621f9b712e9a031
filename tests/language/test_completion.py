"""Things seen from above reach down to the support."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fakes.household import FORWARD, UP, scene, thing

from thinkgrasp.language.completion import stand_down
from thinkgrasp.language.grounding import ground
from thinkgrasp.language.query import parse
from thinkgrasp.types import Obstruction, Proposal


def lid(top_m: float, mark: int = 1) -> Proposal:
    """A disc of 7 cm, 3 mm thick, whose top is at this height: all that a camera above a can sees."""
    disc = thing(
        mark,
        (0.1 * mark, 0),
        (0.07, 0.069, 0.003),
        {"red": 0.9},
        {"cylindrical": 0.9, "flat": 1.0},
        raised=top_m - 0.003,
    )
    T = disc.T_camera_object.copy()
    T[:3, :3] = np.stack([np.array([1.0, 0, 0]), FORWARD, np.cross([1.0, 0, 0], FORWARD)], axis=1)
    assert abs(T[:3, 2] @ UP) == pytest.approx(1)
    return replace(disc, T_camera_object=T)


def test_a_lid_becomes_a_can() -> None:
    seen = scene([lid(0.11)])
    can = stand_down(seen).proposals[0]
    assert can.extents_m == pytest.approx((0.11, 0.07, 0.069))
    assert can.shape_degree("flat") == 0
    assert can.height_m == (0.0, pytest.approx(0.11))
    assert np.linalg.det(can.T_camera_object[:3, :3]) == pytest.approx(1)
    assert abs(can.T_camera_object[:3, 0] @ UP) == pytest.approx(1)
    assert ground(seen, parse("the can")).fitting()


def test_a_tall_one_becomes_long() -> None:
    assert stand_down(scene([lid(0.2)])).proposals[0].shape_degree("elongated") == 1.0


def test_a_disc_on_the_table_stays_a_disc() -> None:
    seen = scene([lid(0.004)])
    assert stand_down(seen).proposals == seen.proposals
    assert not ground(seen, parse("the can")).fitting()


def test_what_rests_on_something_is_not_lengthened() -> None:
    seen = scene([lid(0.11), lid(0.05, 2)], [Obstruction("rests_on", 1, 2, 0.0, "m")])
    assert stand_down(seen).proposals[0] is seen.proposals[0]


def test_without_support_nothing_changes() -> None:
    seen = replace(scene([lid(0.11)]), support=None)
    assert stand_down(seen) is seen
