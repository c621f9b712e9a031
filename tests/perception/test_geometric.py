"""The stage as a whole: workspace, sizes, kinds of missing depth, settings."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from fakes.tables import BLUE, PURPLE, RED, matches, overlap, perceive, view, without_pose

from thinkgrasp.errors import ConfigError
from thinkgrasp.interfaces import ScenePerception
from thinkgrasp.perception import GeometricPerception
from thinkgrasp.sim import tabletop as t
from thinkgrasp.types import Scene

THINGS = (
    t.box("box", (0.10, 0.07, 0.12), RED, t.pose(-0.14, 0.0, 0, 0.5)),
    t.can("can", 0.034, 0.10, BLUE, t.pose(0.0, 0.05)),
    t.ball("ball", 0.035, PURPLE, t.pose(0.13, 0.0)),
)


@cache
def rendered(size: tuple[int, int] = (640, 480)) -> t.Rendering:
    return view(*THINGS, size=size)


@cache
def seen(size: tuple[int, int] = (640, 480)) -> Scene:
    return perceive(rendered(size))


def check_sizes(scene: Scene, size: tuple[int, int]) -> None:
    hw = (size[1], size[0])
    assert scene.points.shape == (*hw, 3)
    assert scene.normals is not None
    assert scene.normals.shape == (*hw, 3)
    assert scene.region is not None
    assert scene.region.shape == hw
    assert scene.support is not None
    assert scene.support.inliers.shape == hw
    assert all(p.mask.shape == hw for p in scene.proposals)
    assert scene.points.dtype == scene.normals.dtype == np.float32


@pytest.mark.parametrize("size", [(640, 480), (641, 479), (320, 240), (963, 541)])
def test_any_image_size_finds_the_same_things(size: tuple[int, int]) -> None:
    scene = seen(size)
    check_sizes(scene, size)
    pairs = matches(scene, rendered(size))
    assert len(scene.proposals) == 3
    assert min(iou for _, iou in pairs) > 0.75
    for (p, _), (q, _) in zip(pairs, matches(seen(), rendered()), strict=True):
        np.testing.assert_allclose(p.extents_m, q.extents_m, atol=0.008)
        assert p.colors[0][0] == q.colors[0][0]


def test_it_is_a_scene_stage() -> None:
    stage: ScenePerception = GeometricPerception()
    assert stage.perceive(without_pose(rendered((320, 240)).frame)).support is not None


def test_nan_and_zero_mean_the_same() -> None:
    frame = without_pose(rendered().frame)
    assert (frame.depth == 0).any(), "the sensor model was meant to leave holes"
    nan = replace(frame, depth=np.where(frame.depth > 0, frame.depth, np.float32(np.nan)))
    a, b = seen(), GeometricPerception().perceive(nan)
    assert a.support is not None
    assert b.support is not None
    np.testing.assert_array_equal(a.support.normal, b.support.normal)
    assert len(a.proposals) == len(b.proposals)
    for p, q in zip(a.proposals, b.proposals, strict=True):
        np.testing.assert_array_equal(p.mask, q.mask)


def test_nothing_outside_the_workspace_is_proposed() -> None:
    rendering = rendered()
    workspace = np.zeros(rendering.labels.shape, bool)
    workspace[:, :260] = True
    scene = GeometricPerception().perceive(replace(without_pose(rendering.frame), workspace=workspace))
    assert len(scene.proposals) == 1
    assert overlap(scene.proposals[0].mask, rendering.mask(0)) > 0.75
    assert not (scene.proposals[0].mask & ~workspace).any()
    assert scene.region is not None
    assert not (scene.region & ~workspace).any()


def test_an_empty_workspace_has_no_things_and_keeps_the_support() -> None:
    rendering = rendered((320, 240))
    nowhere = np.zeros(rendering.labels.shape, bool)
    scene = GeometricPerception().perceive(replace(without_pose(rendering.frame), workspace=nowhere))
    assert scene.support is not None
    assert scene.proposals == ()


def test_a_smaller_working_width_finds_the_same_things() -> None:
    rendering = rendered()
    scene = GeometricPerception(work_width_px=320).perceive(without_pose(rendering.frame))
    check_sizes(scene, (640, 480))
    pairs = matches(scene, rendering)
    assert len(scene.proposals) == 3
    assert min(iou for _, iou in pairs) > 0.75
    blocks = scene.proposals[0].mask.reshape(240, 2, 320, 2)
    assert (blocks.all(axis=(1, 3)) == blocks.any(axis=(1, 3))).all(), "the work was meant to be at half the size"


def test_points_are_the_whole_frames_at_any_working_width() -> None:
    rendering = rendered()
    scene = GeometricPerception(work_width_px=320).perceive(without_pose(rendering.frame))
    np.testing.assert_array_equal(scene.points, seen().points)


@pytest.mark.parametrize("width", [159, 0, -640])
def test_a_working_width_that_is_too_small_is_refused(width: int) -> None:
    with pytest.raises(ConfigError, match=f"work_width_px must be at least 160, got {width}"):
        GeometricPerception(work_width_px=width)


def test_a_known_pose_changes_nothing_where_the_support_is_clear() -> None:
    posed = GeometricPerception().perceive(rendered().frame)
    assert len(posed.proposals) == 3
    for p, q in zip(posed.proposals, seen().proposals, strict=True):
        assert overlap(p.mask, q.mask) > 0.95


def test_a_pose_whose_world_is_not_upright_is_named() -> None:
    frame = rendered().frame
    assert frame.T_world_camera is not None
    lying = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # world turned about its x axis
    scene = GeometricPerception().perceive(replace(frame, T_world_camera=lying @ frame.T_world_camera))
    assert scene.proposals == ()
    (said,) = scene.degraded
    assert said.stage == "scene"
    assert "z axis must point up" in said.reason
    assert GeometricPerception().perceive(frame).degraded == ()
