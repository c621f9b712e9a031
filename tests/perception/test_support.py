"""The support plane: which plane it is, and how well it is measured, on rendered rooms where the truth is known."""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from fakes.tables import BLUE, CHAIR, DESK, GREEN, RED, pinhole, view, without_pose

from thinkgrasp.geometry import deproject, organised_normals
from thinkgrasp.perception import GeometricPerception
from thinkgrasp.perception.support import find_support, plane_axes, tolerance
from thinkgrasp.sim import tabletop as t
from thinkgrasp.sim.solids import Box
from thinkgrasp.types import CameraIntrinsics, Frame, Scene

THINGS = (
    t.box("box", (0.10, 0.06, 0.16), RED, t.pose(-0.12, 0.05, 0, 0.4)),
    t.can("can", 0.034, 0.10, BLUE, t.pose(0.02, -0.06)),
    t.bowl("bowl", 0.075, 0.05, GREEN, t.pose(0.14, 0.06)),
)


@cache
def room(size: tuple[int, int], dropout: float) -> t.Rendering:
    """A small table on a floor, with a higher desk behind and a chair beside it."""
    return view(
        *THINGS, eye=(0.1, -0.85, 0.62), size=size, dropout=dropout, table_m=(0.55, 0.5), background=(DESK, CHAIR)
    )


def errors(scene: Scene, rendering: t.Rendering) -> tuple[float, float]:
    """Return how far the found plane is off the table: angle [deg] and height at the table's middle [m]."""
    T = rendering.frame.T_world_camera
    assert T is not None
    assert scene.support is not None
    up = T[:3, :3] @ scene.support.normal
    middle = -T[:3, :3].T @ T[:3, 3]
    return float(np.degrees(np.arccos(np.clip(up[2], -1, 1)))), abs(float(scene.support.height(middle)))


@pytest.mark.parametrize("posed", [True, False])
@pytest.mark.parametrize(("size", "dropout"), [((640, 480), 0.0), ((640, 480), 0.2), ((1280, 720), 0.2)])
def test_small_table_is_found_among_floor_desk_and_chair(size: tuple[int, int], dropout: float, posed: bool) -> None:
    rendering = room(size, dropout)
    frame = rendering.frame if posed else without_pose(rendering.frame)
    scene = GeometricPerception().perceive(frame)
    angle, offset = errors(scene, rendering)
    assert angle < 2.0
    assert offset < 0.01
    assert scene.support is not None
    assert scene.support.inliers.shape == (size[1], size[0])
    assert scene.support.inliers.mean() < 0.34, "the scene was meant to show a table that fills at most a third"


@pytest.mark.parametrize("eye", [(0.0, -0.1, 0.8), (0.5, -0.4, 0.3), (0.0, -0.75, 0.35)])
def test_plane_is_right_from_above_and_from_low(eye: tuple[float, float, float]) -> None:
    rendering = view(*THINGS, eye=eye, size=(320, 240))
    angle, offset = errors(GeometricPerception().perceive(without_pose(rendering.frame)), rendering)
    assert angle < 2.0
    assert offset < 0.01


def test_exact_depth_gives_an_exact_plane() -> None:
    rendering = view(*THINGS, size=(320, 240), noise=False)
    scene = GeometricPerception().perceive(rendering.frame)
    angle, offset = errors(scene, rendering)
    assert angle < 0.3
    assert offset < 0.001
    assert scene.support is not None
    assert np.linalg.norm(scene.support.normal) == pytest.approx(1.0, abs=1e-9)


def test_pose_overrules_the_larger_plane() -> None:
    """A wall fills most of the view, a strip of table the rest: with a pose the wall cannot be the support."""
    wall = t.TableObject("wall", (Box((3.0, 0.02, 3.0), GREEN, t.pose(0, 0.12, 0.5)),), np.eye(4))
    rendering = view(THINGS[1], eye=(0.0, -0.5, 0.35), target=(0.0, 0.0, 0.1), size=(320, 240), background=(wall,))
    angle, offset = errors(GeometricPerception().perceive(rendering.frame), rendering)
    assert angle < 2.0
    assert offset < 0.01


def frame_of(depth: np.ndarray, camera: CameraIntrinsics, T: np.ndarray | None = None) -> Frame:
    color = np.full((*depth.shape, 3), 128, np.uint8)
    return Frame(color, depth.astype(np.float32), camera, T)


def nothing(depth: np.ndarray, T: np.ndarray | None = None) -> Scene:
    """Perceive a depth image and require that nothing warns."""
    camera = pinhole(depth.shape[1], depth.shape[0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return GeometricPerception().perceive(frame_of(depth, camera, T))


@pytest.mark.parametrize(
    "depth",
    [
        pytest.param(np.zeros((240, 320)), id="zero"),
        pytest.param(np.full((240, 320), np.nan), id="nan"),
        pytest.param(np.where(np.arange(240 * 320).reshape(240, 320) < 90, 0.7, 0.0), id="90 pixels"),
        pytest.param(np.random.default_rng(0).uniform(0.3, 3.0, (240, 320)), id="random"),
    ],
)
def test_no_plane_gives_a_scene_without_proposals(depth: np.ndarray) -> None:
    scene = nothing(depth)
    assert scene.support is None
    assert scene.region is None
    assert scene.proposals == ()
    assert scene.obstructions == ()
    assert scene.points.shape == (240, 320, 3)
    np.testing.assert_array_equal(np.isfinite(scene.points[..., 2]), depth > 0)


def test_a_wall_is_no_support_when_the_pose_is_known_and_carries_nothing_when_not() -> None:
    depth = np.full((240, 320), 0.8)
    level = t.look_at((0.0, 0.0, 1.0), (0.0, 1.0, 1.0))
    assert nothing(depth, level).support is None
    assert nothing(depth).proposals == ()


def test_outline_and_footprint_are_metric() -> None:
    rendering = view(size=(320, 240), table_m=(0.30, 0.24), noise=False)
    camera, T = rendering.frame.camera, rendering.frame.T_world_camera
    assert T is not None
    points = deproject(rendering.frame.depth, camera)
    support = find_support(points, organised_normals(points, camera), T[2, :3], np.random.default_rng(0))
    assert support is not None
    world = np.array([[0.0, 0.0, 0.0], [0.13, 0.0, 0.0], [0.25, 0.0, 0.0], [0.0, -0.22, 0.1]])
    seen = (world - T[:3, 3]) @ T[:3, :3]
    outside = support.distance_outside(seen)
    np.testing.assert_allclose(outside[2:], [0.10, 0.10], atol=0.012)
    assert (outside[:2] < 0).all()
    flat = support.footprint(seen)
    np.testing.assert_allclose(np.linalg.norm(flat[1] - flat[0]), 0.13, atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(flat[3] - flat[0]), 0.22, atol=2e-3)


def test_support_does_not_depend_on_the_global_random_state() -> None:
    frame = replace(room((640, 480), 0.2).frame, T_world_camera=None)
    first = GeometricPerception(seed=3).perceive(frame).support
    np.random.default_rng().random(10)
    second = GeometricPerception(seed=3).perceive(frame).support
    assert first is not None
    assert second is not None
    np.testing.assert_array_equal(first.normal, second.normal)
    assert first.offset_m == second.offset_m


def test_axes_are_right_handed_and_turn_little_when_the_normal_does() -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        normal = rng.normal(size=3)
        normal /= np.linalg.norm(normal)
        axes = plane_axes(normal)
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(axes) == pytest.approx(1.0)
        np.testing.assert_allclose(axes[2], normal, atol=1e-9)
        tilted = normal + 1e-4 * np.array([1.0, -1.0, 0.5])
        if normal[2] < 0.5:
            np.testing.assert_allclose(plane_axes(tilted / np.linalg.norm(tilted)), axes, atol=1e-3)


def test_tolerance_grows_with_distance() -> None:
    np.testing.assert_allclose(tolerance(np.array([0.5, 1.0, 2.0])), [0.00625, 0.010, 0.025])
