"""How large what is held is taken to be: as large as it was seen, and no larger than the fingers let it be."""

from __future__ import annotations

import numpy as np
import pytest
from fakes.ros import PACKAGE  # noqa: F401  (puts the package on the path)
from scipy.spatial.transform import Rotation
from thinkgrasp_ros.held import held_box

from thinkgrasp.geometry import apply, make_transform

DOWN = np.diag([1.0, -1.0, -1.0])
"""Straight down; closes along x, the fingers stand along y."""


def sheet(x, y, z, step=0.004) -> np.ndarray:
    """Points on the top of something: (low, high) of x and y, at one height."""
    u, v = np.meshgrid(np.arange(x[0], x[1] + 1e-9, step), np.arange(y[0], y[1] + 1e-9, step))
    return np.stack([u.ravel(), v.ravel(), np.full(u.size, z)], axis=1)


TABLE = sheet((-0.3, 0.3), (-0.3, 0.3), 0.0, 0.01)


def world(box, T) -> tuple[np.ndarray, np.ndarray]:
    """The box's lowest and highest corner, in the world."""
    signs = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, 8).T
    corners = apply(T, box.middle + signs * box.sides / 2)
    return corners.min(axis=0), corners.max(axis=0)


def test_a_bar_is_as_long_as_it_is_and_stands_on_the_table():
    T = make_transform(DOWN, np.array([0.0, 0.0, 0.04]))
    bar = sheet((-0.015, 0.015), (-0.03, 0.07), 0.05)
    low, high = world(held_box(np.concatenate([TABLE, bar]), T, 0.05, 0.1), T)
    assert np.allclose(low, [-0.015, -0.03, 0.0], atol=0.005)
    assert np.allclose(high, [0.015, 0.07, 0.05], atol=0.005)


def test_a_neighbour_beyond_a_gap_or_beside_the_fingers_is_none_of_it():
    T = make_transform(DOWN, np.array([0.0, 0.0, 0.04]))
    bar = sheet((-0.015, 0.015), (-0.03, 0.03), 0.05)
    behind = sheet((-0.02, 0.02), (0.042, 0.08), 0.06)
    beside = sheet((0.03, 0.08), (-0.03, 0.03), 0.06)
    alone = held_box(np.concatenate([TABLE, bar]), T, 0.05, 0.1)
    among = held_box(np.concatenate([TABLE, bar, behind, beside]), T, 0.05, 0.1)
    assert np.allclose(alone.sides, among.sides)
    assert np.allclose(alone.middle, among.middle)


def test_what_is_far_away_does_not_make_it_deeper():
    """A floor beyond the table's edge; and a tall thing whose foot is out of the ball ends at what was seen."""
    T = make_transform(DOWN, np.array([0.0, 0.0, 0.30]))
    top = sheet((-0.02, 0.02), (-0.02, 0.02), 0.31)
    floor = sheet((-0.5, 0.5), (-0.5, 0.5), -0.75, 0.02)
    low, high = world(held_box(np.concatenate([top, floor]), T, 0.06, 0.1), T)
    assert low[2] == pytest.approx(0.2), "as deep as points count, for its foot was not seen"
    assert high[2] < 0.32


def test_a_wide_thing_of_which_only_the_top_was_seen_reaches_as_deep_as_may_be():
    T = make_transform(DOWN, np.array([0.0, 0.0, 0.28]))
    top = sheet((-0.2, 0.2), (-0.2, 0.2), 0.30)
    low, high = world(held_box(top, T, 0.06, 0.1), T)
    assert np.allclose(low, [-0.03, -0.096, 0.18], atol=0.005)
    assert np.allclose(high, [0.03, 0.096, 0.30], atol=0.005)


@pytest.mark.parametrize("cloud", [np.zeros((0, 3)), TABLE - np.array([0, 0, 1.0])])
def test_where_nothing_was_seen_something_is_between_the_fingertips(cloud):
    box = held_box(cloud, make_transform(DOWN, np.array([0.0, 0.0, 0.3])), 0.06, 0.1)
    assert np.allclose(box.sides, 0.02)
    assert np.allclose(box.middle, 0)


@pytest.mark.parametrize("seed", range(8))
def test_whatever_the_pose_every_point_of_it_is_in_the_box(seed):
    """A tilted gripper on a box of points: all of them between the fingers, and their feet, are inside."""
    rng = np.random.default_rng(seed)
    tilt = Rotation.from_euler("zyx", rng.uniform(-1, 1, 3) * [3.0, 0.5, 0.5]).as_matrix()
    T = make_transform(tilt @ DOWN, rng.uniform([-0.05, -0.05, 0.01], [0.05, 0.05, 0.11]))
    thing = apply(T, rng.uniform([-0.02, -0.04, -0.02], [0.02, 0.04, 0.02], (600, 3)))
    cloud = np.concatenate([TABLE, thing])
    box = held_box(cloud, T, 0.05, 0.1)
    near = np.linalg.norm(cloud - T[:3, 3], axis=1) <= 0.1
    own = thing[(np.linalg.norm(thing - T[:3, 3], axis=1) <= 0.1) & (thing[:, 2] > cloud[near, 2].min() + 0.01)]
    feet = own * [1, 1, 0] + [0, 0, cloud[near, 2].min()]
    assert len(own) > 100
    assert not len(box.outside(own, T, 1e-9))
    assert not len(box.outside(feet, T, 1e-9))
    assert (box.sides <= 0.25).all()


def test_points_outside_a_box():
    T = make_transform(DOWN, np.array([0.1, 0.0, 0.2]))
    box = held_box(np.zeros((0, 3)), T, 0.06, 0.1)
    points = np.array([[0.1, 0, 0.2], [0.1, 0.0, 0.235], [0.1, 0.0, 0.225], [0.3, 0, 0.2]])
    assert np.allclose(box.outside(points, T, 0.02), points[[1, 3]])
    assert box.outside(np.zeros((0, 3)), T, 0.02).shape == (0, 3)
