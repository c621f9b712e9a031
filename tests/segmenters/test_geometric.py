from __future__ import annotations

import pytest
from fakes.household import household, scene, thing

from thinkgrasp.errors import ConfigError, ContractError
from thinkgrasp.interfaces import Segmenter
from thinkgrasp.segmenters.geometric import GeometricSegmenter
from thinkgrasp.types import Plan

TABLE = household()


def marks(plan: Plan, **settings: float) -> list[int | None]:
    return [s.mark for s in GeometricSegmenter(**settings).segment(TABLE, plan).segments]  # pyright: ignore[reportArgumentType]


def test_it_is_a_segmenter() -> None:
    assert isinstance(GeometricSegmenter(), Segmenter)


def test_the_planned_mark_comes_first_and_all_that_answer_follow() -> None:
    assert marks(Plan("mug", "", mark=1))[:2] == [1, 2]
    assert marks(Plan("mug", "", mark=2))[:2] == [2, 1]


def test_the_planned_mark_is_kept_whatever_the_text() -> None:
    assert marks(Plan("no such word", "", mark=7)) == [7]


def test_without_a_mark_the_text_decides() -> None:
    assert marks(Plan("red box", ""))[0] == 3
    assert marks(Plan("purple gizmo", "")) == []


def test_segments_are_best_first_and_carry_the_proposals_mask() -> None:
    segments = GeometricSegmenter().segment(TABLE, Plan("mug", "", mark=1)).segments
    scores = [s.score for s in segments]
    assert scores == sorted(scores, reverse=True)
    assert all(s.mark is not None and s.mask is TABLE.proposal(s.mark).mask for s in segments)


def test_an_obstruction_is_returned_alone() -> None:
    assert marks(Plan("mug", "", role="obstruction", mark=2)) == [2]


def test_a_part_falls_back_to_the_object_and_says_so() -> None:
    result = GeometricSegmenter().segment(TABLE, Plan("mug", "", kind="part", mark=2))
    assert result.segments[0].mark == 2
    assert [d.stage for d in result.degraded] == ["segment"]
    assert "grid cell" in result.degraded[0].fallback


def test_no_proposals_is_said() -> None:
    result = GeometricSegmenter().segment(scene([]), Plan("mug", ""))
    assert result.segments == ()
    assert "no object proposals" in result.degraded[0].reason


def test_at_most_so_many() -> None:
    apples = [thing(m, (0.1 * m - 0.3, 0), (0.07, 0.07, 0.07), {"red": 0.9}, {"round": 0.9}) for m in range(1, 6)]
    result = GeometricSegmenter(max_segments=3).segment(scene(apples), Plan("apple", ""))
    assert len(result.segments) == 3


def test_a_mark_that_does_not_exist_is_a_broken_contract() -> None:
    with pytest.raises(ContractError, match="no proposal has mark 99"):
        marks(Plan("mug", "", mark=99))


@pytest.mark.parametrize("settings", [{"min_score": 0}, {"min_score": 1}, {"max_segments": 0}])
def test_settings_are_checked(settings: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match="geometric segmenter"):
        GeometricSegmenter(**settings)  # pyright: ignore[reportArgumentType]
