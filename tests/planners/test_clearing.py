"""What has to go first, and what may hide an unseen goal."""

from __future__ import annotations

import pytest
from fakes.household import scene, thing

from thinkgrasp.planners.clearing import in_the_way, likely_hider, piles, severity, shadow_m, way_to
from thinkgrasp.types import Obstruction, Proposal, Scene


def block(mark: int, at: tuple[float, float] = (0, 0), raised: float = 0.0, **kwargs: float) -> Proposal:
    return thing(
        mark,
        at,
        (0.08, 0.08, 0.05),
        {"grey": 1.0},
        {"box-like": 0.9},
        raised=raised,
        confidence=kwargs.get("confidence", 0.9),
    )


def tower() -> Scene:
    """3 on 2 on 1, and 4 beside them."""
    blocks = [block(1), block(2, raised=0.05), block(3, raised=0.10), block(4, (0.3, 0))]
    return scene(blocks, [Obstruction("rests_on", 2, 1, 0.0, "m"), Obstruction("rests_on", 3, 2, 0.0, "m")])


def test_the_way_lists_every_step() -> None:
    way = way_to(tower(), 1)
    assert way.marks == (1, 2, 3)
    assert [e.a for e in way.edges] == [2, 3]
    assert way.first == 3
    assert way_to(tower(), 4).marks == (4,)


def test_what_the_goal_rests_on_is_not_in_its_way() -> None:
    assert way_to(tower(), 3).first == 3


def test_skipped_marks_are_left() -> None:
    assert way_to(tower(), 1, skip={3}).first == 2
    assert way_to(tower(), 1, skip={2}).first == 1


@pytest.mark.parametrize(("share", "severe"), [(0.05, False), (0.25, False), (0.4, True), (0.8, True)])
def test_hiding_counts_by_the_hidden_share_of_the_whole(share: float, severe: bool) -> None:
    a, b = block(1), block(2, (0.05, 0.1))
    hidden = share / (1 - share) * float(b.mask.sum())
    edge = Obstruction("hides", 1, 2, hidden, "px")
    assert (severity(scene([a, b], [edge]), edge) >= 0.5) == severe


def test_an_unsure_thing_is_not_in_the_way() -> None:
    edge = Obstruction("rests_on", 2, 1, 0.0, "m")
    view = scene([block(1), block(2, raised=0.05, confidence=0.1)], [edge])
    assert severity(view, edge) == 0
    assert in_the_way(view, 1) == []


def test_wide_clearance_and_low_neighbours_do_not_block() -> None:
    low, high = block(1), block(2, (0.1, 0), raised=0.05)
    assert severity(scene([low, high]), Obstruction("blocks", 2, 1, 0.03, "m")) == 0
    assert severity(scene([low, high]), Obstruction("blocks", 2, 1, 0.002, "m")) > 0.5
    assert severity(scene([low, high]), Obstruction("blocks", 1, 2, 0.002, "m")) < 0.5


def test_piles_are_stacks_or_four_in_contact() -> None:
    assert piles(tower()) == [{1, 2, 3}]
    row = [block(m, (0.08 * m - 0.2, 0)) for m in range(1, 5)]
    touching = [Obstruction("blocks", m, m + 1, 0.002, "m") for m in range(1, 4)]
    assert piles(scene(row, touching)) == [{1, 2, 3, 4}]
    assert piles(scene(row[:3], touching[:2])) == []
    assert piles(scene(row)) == []


def test_one_thing_on_another_is_no_pile_that_hides_anything() -> None:
    pair = scene([block(1), block(2, raised=0.05)], [Obstruction("rests_on", 2, 1, 0.0, "m")])
    assert piles(pair) == []
    assert likely_hider(pair, 0.05, 0.02, in_piles_only=True) is None


def test_the_free_thing_on_top_of_a_pile_hides_the_goal() -> None:
    hider = likely_hider(tower(), 0.08, 0.03, in_piles_only=True)
    assert hider is not None
    assert hider.mark == 3
    assert likely_hider(tower(), 0.5, 0.3, in_piles_only=True) is None


def test_a_tall_thing_throws_a_longer_shadow_than_a_flat_one() -> None:
    tall = thing(1, (0, 0), (0.1, 0.1, 0.3), {}, {})
    flat = thing(2, (0.2, 0), (0.1, 0.1, 0.02), {}, {})
    view = scene([tall, flat])
    assert shadow_m(view, tall)[1] > 5 * shadow_m(view, flat)[1]
    assert shadow_m(view, tall)[1] == pytest.approx(0.3, rel=0.35)  # seen at about 45 degrees
