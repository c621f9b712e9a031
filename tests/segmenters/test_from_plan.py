"""Regions that a plan itself gives: its box, or the surroundings of its pixel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thinkgrasp.errors import ConfigError
from thinkgrasp.segmenters.from_plan import PlanBoxSegmenter, PlanPointSegmenter
from thinkgrasp.testing import sample_scene, strict_scene
from thinkgrasp.types import Plan

SCENE = sample_scene()
THING = SCENE.proposals[2]
X0, Y0, X1, Y1 = THING.box_xyxy


def pixel_on(mask) -> tuple[int, int]:
    v, u = np.nonzero(mask)
    return int(u[len(u) // 2]), int(v[len(v) // 2])


def test_the_box_crops_what_is_measured_above_the_support():
    (segment,) = PlanBoxSegmenter().segment(SCENE, Plan("thing", "", crop_xyxy=THING.box_xyxy, mark=3)).segments
    assert segment.mask[THING.mask & SCENE.region].all()
    inside = np.zeros_like(segment.mask)
    inside[Y0:Y1, X0:X1] = True
    assert not (segment.mask & ~inside).any()
    assert not (segment.mask & ~SCENE.region).any()
    assert (segment.label, segment.mark, segment.score) == ("thing", 3, 1.0)


def test_in_strict_mode_the_box_holds_the_table_too():
    scene = strict_scene()
    (segment,) = PlanBoxSegmenter().segment(scene, Plan("thing", "", crop_xyxy=(0, 10, 40, 60))).segments
    measured = np.isfinite(scene.points[10:60, 0:40, 2])
    np.testing.assert_array_equal(segment.mask[10:60, 0:40], measured)
    assert segment.touches_border


def test_the_ball_around_the_pixel():
    u, v = pixel_on(THING.mask & SCENE.region)
    (segment,) = PlanPointSegmenter(radius_m=0.02).segment(SCENE, Plan("thing", "", point_px=(u, v))).segments
    assert segment.mask[v, u]
    distance = np.linalg.norm(SCENE.points[segment.mask] - SCENE.points[v, u], axis=1)
    assert 0.01 < distance.max() <= 0.02
    wider = PlanPointSegmenter(radius_m=0.06).segment(SCENE, Plan("thing", "", point_px=(u, v))).segments[0]
    assert wider.mask[segment.mask].all()
    assert wider.mask.sum() > segment.mask.sum()


def test_a_pixel_without_depth_takes_the_nearest_one():
    u, v = pixel_on(THING.mask & SCENE.region)
    points = SCENE.points.copy()
    points[v, u] = np.nan
    (segment,) = (
        PlanPointSegmenter().segment(replace(SCENE, points=points), Plan("thing", "", point_px=(u, v))).segments
    )
    assert not segment.mask[v, u]
    assert segment.mask[v, u + 1] or segment.mask[v, u - 1]


@pytest.mark.parametrize(
    ("segmenter", "plan", "reason"),
    [
        (PlanBoxSegmenter(), Plan("thing", ""), "the plan has no cropping box"),
        (PlanPointSegmenter(), Plan("thing", ""), "the plan names no pixel"),
    ],
)
def test_what_the_plan_does_not_say_is_no_segment(segmenter, plan, reason):
    found = segmenter.segment(SCENE, plan)
    assert found.segments == ()
    assert [d.reason for d in found.degraded] == [reason]


@pytest.mark.parametrize("segmenter", [PlanBoxSegmenter(), PlanPointSegmenter()])
def test_where_nothing_is_measured_is_no_segment(segmenter):
    blind = replace(SCENE, points=np.full_like(SCENE.points, np.nan))
    found = segmenter.segment(blind, Plan("thing", "", crop_xyxy=(5, 5, 9, 9), point_px=(6, 6)))
    assert found.segments == ()
    assert "nothing is measured" in found.degraded[0].reason


@pytest.mark.parametrize("radius", [0, -1, 2, float("nan")])
def test_a_radius_is_a_length(radius):
    with pytest.raises(ConfigError, match="radius_m"):
        PlanPointSegmenter(radius_m=radius)
