"""Cubes stand upright on the support and cover what is asked for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thinkgrasp.errors import ConfigError
from thinkgrasp.generators.cubes import USABLE, place_cubes, supported
from thinkgrasp.generators.surface import Upright
from thinkgrasp.geometry import apply, invert
from thinkgrasp.testing import sample_frame, sample_scene, strict_scene

UPRIGHT = Upright(np.array([0, -1, 0], np.float32), np.array([0, 0, 1], np.float32), 0.4)
"""A level camera, 0.4 m above the support."""


def spread(width_m: float, depth_m: float, n: int = 2000) -> np.ndarray:
    """Points on the support of a rectangle before the camera."""
    p = np.random.default_rng(0).uniform(-0.5, 0.5, (n, 2)) * [width_m, depth_m]
    return np.stack([p[:, 0], np.full(n, 0.4), p[:, 1] + 0.8], axis=1).astype(np.float32)


def cubes(points: np.ndarray, **changes: object) -> list[np.ndarray]:
    settings = {"side_m": 0.3, "support_m": 0.05, "yaws_rad": (0.0,), "max_cubes": 16}
    return place_cubes(points, UPRIGHT, **(settings | changes))


def test_a_small_thing_stands_in_the_middle_of_one_upright_cube():
    points = spread(0.06, 0.04)
    (T,) = cubes(points)
    np.testing.assert_allclose(T[:3, :3].T @ T[:3, :3], np.eye(3), atol=1e-6)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
    np.testing.assert_allclose(T[:3, 2], UPRIGHT.up, atol=1e-6)
    np.testing.assert_allclose(T[:3, 0], UPRIGHT.away, atol=1e-6)
    inside = apply(invert(T), points.astype(np.float64))
    np.testing.assert_allclose((inside.min(axis=0) + inside.max(axis=0))[:2] / 2, 0.15, atol=1e-6)
    np.testing.assert_allclose(inside[:, 2], 0.05, atol=1e-6)


@pytest.mark.parametrize(("width", "depth", "n"), [(0.19, 0.19, 1), (0.5, 0.1, 3), (0.5, 0.5, 9)])
def test_what_is_larger_is_covered_by_the_middles_of_several(width, depth, n):
    points = spread(width, depth)
    found = cubes(points)
    assert len(found) == n
    inside = np.stack([apply(invert(T), points.astype(np.float64))[:, :2] for T in found])
    assert (np.abs(inside - 0.15) <= 0.3 * USABLE / 2 + 1e-6).all(axis=2).any(axis=0).all()


def test_cells_without_points_get_no_cube_and_the_fullest_stay():
    left, right = spread(0.05, 0.05), spread(0.05, 0.05, n=20)
    left[:, 0] -= 1
    right[:, 0] += 1
    both = np.concatenate([left, right])
    assert len(cubes(both)) == 2
    (T,) = cubes(both, max_cubes=1)
    assert apply(invert(T), left.astype(np.float64))[:, 1].mean() == pytest.approx(0.15, abs=0.11)


def test_each_turn_covers_all():
    found = cubes(spread(0.1, 0.1), yaws_rad=(0.0, np.pi / 6))
    assert len(found) == 2
    assert found[0][:3, 0] @ found[1][:3, 0] == pytest.approx(np.cos(np.pi / 6))


def test_one_point_has_its_cube():
    assert len(cubes(spread(0.1, 0.1)[:1])) == 1


def test_a_known_support_stays():
    scene = sample_scene()
    assert supported(scene, scene.points[scene.proposals[0].mask]) is scene


def test_without_a_plane_the_camera_pose_tells_up_and_the_lowest_points_the_support():
    scene, full = strict_scene(), sample_scene()
    found = supported(scene, scene.points[full.proposals[0].mask & np.isfinite(scene.points[..., 2])]).support
    np.testing.assert_allclose(found.normal, full.support.normal, atol=1e-6)
    assert found.offset_m == pytest.approx(full.support.offset_m, abs=0.01)


def test_without_plane_and_pose_it_says_what_is_missing():
    scene = replace(strict_scene(), frame=sample_frame(pose=False))
    with pytest.raises(ConfigError, match="neither a support plane nor T_world_camera"):
        supported(scene, scene.points[np.isfinite(scene.points[..., 2])])
