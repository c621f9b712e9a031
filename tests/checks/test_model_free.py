"""The model-free collision detector against the official one's results, and as a check."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from thinkgrasp.checks.model_free import ModelFreeCollisionCheck, averaged_voxels, occupancy
from thinkgrasp.errors import ConfigError, InputError
from thinkgrasp.gripper import GRIPPERS
from thinkgrasp.testing import sample_scene
from thinkgrasp.types import Grasps, Segment

GOLDEN = Path(__file__).resolve().parents[3] / "shared" / "grasp_networks"
GRIPPER = GRIPPERS["robotiq_2f85"]
needs_golden = pytest.mark.skipif(not GOLDEN.is_dir(), reason=f"no golden data at {GOLDEN}")


def measured(data, voxel_m: float, approach_m: float):
    grasps = data["grasps"].astype(np.float64)
    rotations, seeds = grasps[:, 4:13].reshape(-1, 3, 3), grasps[:, 13:16]
    voxels = averaged_voxels(data["cloud"], voxel_m)
    return occupancy(voxels, rotations, seeds, grasps[:, 1], grasps[:, 3], voxel_m, approach_m)


@needs_golden
@pytest.mark.parametrize("net", ["graspnet", "fgc"])
def test_golden(net):
    data = np.load(GOLDEN / f"golden_{net}.npz")
    voxels = averaged_voxels(data["cloud"], 0.01)
    assert np.array_equal(
        voxels[np.lexsort(voxels.T)], data["voxel_points_0p01"][np.lexsort(data["voxel_points_0p01"].T)]
    )
    found = measured(data, 0.01, 0.05)
    np.testing.assert_allclose(found.parts, data["collision_ious"], rtol=0, atol=1e-6)
    assert np.array_equal(found.parts[0] > 0.01, data["collision_mask"])
    assert np.array_equal(found.between < 0.01, data["empty_mask"])
    found = measured(data, 0.005, 0.03)
    np.testing.assert_allclose(found.parts, data["collision_ious_v005_a03"], rtol=0, atol=1e-6)
    assert np.array_equal(found.parts[0] > 0.05, data["collision_mask_v005_a03_t05"])


def test_voxels_average_and_start_half_a_cell_early():
    points = np.array([[0.0, 0, 0], [0.004, 0, 0], [0.006, 0, 0], [0.024, 0, 0]])
    np.testing.assert_allclose(averaged_voxels(points, 0.01), [[0.002, 0, 0], [0.006, 0, 0], [0.024, 0, 0]])
    assert averaged_voxels(np.zeros((0, 3)), 0.01).shape == (0, 3)
    with pytest.raises(InputError, match="too many cells"):
        averaged_voxels(np.array([[0.0, 0, 0], [1e9, 1e9, 1e9]]), 0.001)


EYE = np.eye(3)[None]
"""Approach along x, closing along y."""


@pytest.mark.parametrize(
    ("point", "part"),
    [
        ((-0.03, 0.025, 0), 2),
        ((-0.03, -0.025, 0), 1),
        ((-0.065, 0, 0), 3),
        ((-0.1, 0, 0), 4),
        ((-0.03, 0, 0), None),  # between the fingers
        ((-0.03, 0.025, 0.011), None),  # beside their breadth
        ((0.001, 0.025, 0), None),  # before the tips
        ((0.0, 0.025, 0), None),  # limits are strict
        ((-0.0601, 0.01, 0), 3),
        ((-0.121, 0, 0), None),  # behind the way
    ],
)
@pytest.mark.parametrize("depth", [0.0, 0.04])
def test_each_part_is_where_it_should_be(point, part, depth):
    seed = np.array([[0.1, 0.2, 0.5]])
    tip = seed + np.array([[depth, 0, 0]])
    found = occupancy(tip + np.array([point]), EYE, seed, np.array([0.04]), np.array([depth]), 0.01, 0.05)
    full = np.flatnonzero(found.parts[:, 0] > 0)
    assert full.tolist() == ([] if part is None else [0, part])
    volume = (2 * 0.02 * 0.06 * 0.01 + 0.02 * 0.06 * 0.01 + 0.02 * 0.06 * 0.05) / 0.01**3
    assert part is None or found.parts[0, 0] == pytest.approx(1 / (volume + 1e-6))
    assert (found.between[0] > 0) == (point == (-0.03, 0, 0))


def test_nothing_opened_is_never_called_empty():
    found = occupancy(np.ones((1, 3)), EYE, np.zeros((1, 3)), np.zeros(1), np.zeros(1), 0.01, 0.05)
    assert np.isnan(found.between[0])


def whole(scene) -> Segment:
    p = scene.proposals[0]
    return Segment("thing", 1.0, p.mask, p.box_xyxy, p.touches_border, p.mark)


def looking_down(scene, positions) -> Grasps:
    """Grasps along the support's normal."""
    z = -scene.support.normal
    x = np.cross(z, [0.3, 0.9, 0.1])
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z], axis=1)
    n = len(positions)
    return Grasps(
        np.repeat(R[None], n, 0).astype(np.float32),
        np.asarray(positions, np.float32),
        np.full(n, 0.04, np.float32),
        np.full(n, 0.5, np.float32),
    )


def test_the_full_cloud_counts_not_the_target_alone():
    """Fingers in the table, in a neighbour, and in the air."""
    scene = sample_scene()
    points, up = scene.points, scene.support.normal
    v, u = np.argwhere(scene.support.inliers & np.isfinite(points[..., 2]))[1000]
    neighbour = scene.proposals[1].center_m
    places = [points[v, u] - 0.01 * up, neighbour, points[v, u] + 0.25 * up]
    grasps = looking_down(scene, places)
    check = ModelFreeCollisionCheck()
    assert check.keep(scene, whole(scene), grasps, GRIPPER).tolist() == [False, False, True]
    blank = replace(scene, points=np.full_like(points, np.nan))
    assert check.keep(blank, whole(scene), grasps, GRIPPER).all()
    emptied = ModelFreeCollisionCheck(min_between=0.01).keep(scene, whole(scene), grasps, GRIPPER)
    assert not emptied[2]


def test_settings():
    for wrong in ({"voxel_m": 0}, {"approach_m": -1}, {"max_share": 1}, {"min_between": -0.1}):
        with pytest.raises(ConfigError, match="model-free collision check"):
            ModelFreeCollisionCheck(**wrong)
