"""Depth views become the field that volumetric networks look at."""

from __future__ import annotations

import numpy as np
import pytest

from thinkgrasp.errors import InputError
from thinkgrasp.geometry import make_transform
from thinkgrasp.networks.tsdf import fuse
from thinkgrasp.types import CameraIntrinsics

CAMERA = CameraIntrinsics(80, 60, 70.0, 70.0, 39.5, 29.5)
DOWN = np.diag([1.0, -1.0, -1.0])


def straight_down(height_m: float = 0.6, side_m: float = 0.3) -> np.ndarray:
    """A camera over the middle of the cube, looking down; the cube's corner is the origin."""
    return make_transform(DOWN, np.array([-side_m / 2, side_m / 2, height_m]))[None]


def plane(distance_m: float) -> np.ndarray:
    return np.full((1, 60, 80), distance_m, np.float32)


def test_a_plane_seen_from_above_is_half_at_its_height_and_zero_far_from_it():
    grid = fuse(plane(0.55), CAMERA, straight_down(), length_m=0.3, resolution=40).grid()
    column = grid[20, 20]
    height = (np.arange(40) + 0.5) * 0.0075
    near = np.abs(height - 0.05) < 0.029
    np.testing.assert_allclose(column[near], 0.5 + (height[near] - 0.05) / 0.06, atol=2e-3)
    assert not column[height > 0.081].any()
    assert not column[height < 0.019].any()


def test_the_cube_has_no_scale_of_its_own():
    small = fuse(plane(0.55), CAMERA, straight_down(), length_m=0.3, resolution=40)
    large = fuse(plane(1.10), CAMERA, straight_down(1.2, 0.6), length_m=0.6, resolution=40)
    np.testing.assert_allclose(small.grid(), large.grid(), atol=1e-5)


def test_views_are_averaged_with_equal_weight():
    views = np.concatenate([plane(0.55), plane(0.56)])
    field = fuse(views, CAMERA, np.repeat(straight_down(), 2, axis=0), length_m=0.3, resolution=40)
    single = [fuse(v[None], CAMERA, straight_down(), length_m=0.3, resolution=40) for v in views]
    both = (single[0].weights > 0) & (single[1].weights > 0)
    np.testing.assert_allclose(field.values[both], (single[0].values[both] + single[1].values[both]) / 2, atol=1e-6)
    assert field.weights.max() == 2


@pytest.mark.parametrize("hole", [0.0, np.nan, -1.0, np.inf, 5.0])
def test_what_is_no_return_is_unseen(hole):
    depth = plane(0.55)
    depth[0, :, 40:] = hole
    field = fuse(depth, CAMERA, straight_down(), length_m=0.3, resolution=40)
    full = fuse(plane(0.55), CAMERA, straight_down(), length_m=0.3, resolution=40)
    assert not field.weights[23:].any()
    np.testing.assert_array_equal(field.values[:17], full.values[:17])


def test_what_lies_behind_the_camera_is_unseen():
    field = fuse(plane(0.55), CAMERA, straight_down(-0.1), length_m=0.3, resolution=40)
    assert not field.weights.any()


@pytest.mark.parametrize(
    ("depth", "T"),
    [
        (plane(0.5)[0], straight_down()),
        (plane(0.5)[:0], straight_down()[:0]),
        (plane(0.5), straight_down()[0]),
        (np.zeros((1, 30, 30), np.float32), straight_down()),
    ],
)
def test_shapes_that_disagree_are_refused(depth, T):
    with pytest.raises(InputError, match="depth"):
        fuse(depth, CAMERA, T, length_m=0.3, resolution=40)
