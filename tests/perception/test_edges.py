"""Borders between labelled areas: which is in front, what is no step, and what meets across a gap."""

from __future__ import annotations

import numpy as np
import pytest
from fakes.surfaces import HEIGHT, WIDTH, cylinder, pixels, plane

from thinkgrasp.perception.edges import STEP_M, find_edges, tabulate
from thinkgrasp.perception.morphology import Labels
from thinkgrasp.types import Array, Mask

LEFT = pixels(lambda u, v: u < WIDTH // 2)
TOP = pixels(lambda u, v: v < 40)


def halves(first: Mask) -> Labels:
    return np.where(first, 1, 2).astype(np.int32)


def facing(z: Array) -> tuple[Array, Array]:
    """Points and normals of surfaces that face the camera at these depths (H, W)."""
    points, normals = plane((0, 0, 1), (0, 0, 1))
    return points * z[..., None].astype(np.float32), normals


@pytest.mark.parametrize("first", [LEFT, TOP], ids=["side by side", "one above the other"])
@pytest.mark.parametrize("nearer", [1, 2])
def test_the_nearer_side_of_a_step_is_in_front(first: Mask, nearer: int) -> None:
    labels = halves(first)
    edges = find_edges(labels, *facing(np.where(labels == nearer, 0.6, 0.7)))
    contact, front = tabulate(edges, 2)
    border = HEIGHT if first is LEFT else WIDTH
    expected = np.zeros((2, 2), int)
    expected[nearer - 1, 2 - nearer] = border
    np.testing.assert_array_equal(front, expected)
    assert not contact.any()
    sign = {(1, 2): 1, (2, 1): -1}
    for a, b, step in zip(edges.a + 1, edges.b + 1, edges.step, strict=True):
        assert step == sign[a, b] * (1 if nearer == 1 else -1)


def test_a_step_smaller_than_sensor_noise_is_contact() -> None:
    labels = halves(LEFT)
    small = 0.8 * (STEP_M[0] + STEP_M[1] * 0.6)
    contact, front = tabulate(find_edges(labels, *facing(np.where(LEFT, 0.6, 0.6 + small))), 2)
    assert contact[0, 1] == contact[1, 0] == HEIGHT
    assert not front.any()


@pytest.mark.parametrize("normal", [(0, -1, -1), (0.8, 0, -0.9), (0.6, -0.7, -1)])
def test_a_slanted_plane_has_no_step(normal: tuple[float, float, float]) -> None:
    """The tangent plane explains the difference, unless the surface is seen at such a slant that it may be smear."""
    points, normals = plane(normal, (0, 0, 0.7))
    visible = (points[..., 2] > 0.2) & (points[..., 2] < 2.0)
    for first in (LEFT, TOP):
        edges = find_edges(np.where(visible, halves(first), 0).astype(np.int32), points, normals)
        assert len(edges.step) > 20
        assert (edges.step == 0).all()


def test_a_curved_surface_has_no_step() -> None:
    points, normals, mask = cylinder(0.06, 0.5)
    stripes = pixels(lambda u, v: (u // 6) % 2 == 0) & mask
    edges = find_edges(np.where(mask, halves(stripes), 0).astype(np.int32), points, normals)
    assert len(edges.step) > 300
    assert (edges.step == 0).all()


def test_a_fold_is_no_step() -> None:
    floor, up = plane((0, -1, -0.7), (0, 0, 0.6))
    wall, out = plane((0, 0.7, -1), (0, 0, 0.6))
    below = pixels(lambda u, v: v > HEIGHT / 2)
    edges = find_edges(halves(below), np.where(below[..., None], floor, wall), np.where(below[..., None], up, out))
    assert len(edges.step) >= WIDTH
    assert (edges.step == 0).all()


def gap(width: int) -> tuple[Labels, Array, Array]:
    """Two halves of one plane with unlabelled pixels between."""
    points, normals = plane((0, -1, -1), (0, 0, 0.7))
    between = pixels(lambda u, v: np.abs(u - WIDTH / 2) < width / 2)
    return np.where(between, 0, halves(LEFT)).astype(np.int32), points, normals


def test_areas_meet_across_a_gap_within_reach_only() -> None:
    labels, points, normals = gap(5)
    assert len(find_edges(labels, points, normals).a) == 0
    assert len(find_edges(labels, points, normals, reach_px=1).a) == 0
    edges = find_edges(labels, points, normals, reach_px=3)
    assert len(edges.a) == HEIGHT
    assert (edges.step == 0).all()
    assert not edges.blind.any()


def test_areas_meet_further_where_depth_is_missing() -> None:
    labels, points, normals = gap(19)
    assert len(find_edges(labels, points, normals, reach_px=3, blind_reach_px=15).a) == 0
    points[labels == 0] = np.nan
    edges = find_edges(labels, points, normals, reach_px=3, blind_reach_px=15)
    assert len(edges.a) == HEIGHT
    assert edges.blind.all()


def test_unknown_normals_fall_back_to_the_plain_difference() -> None:
    points, normals = facing(np.where(LEFT, 0.6, 0.7))
    edges = find_edges(halves(LEFT), points, np.full_like(normals, np.nan))
    assert (np.where(edges.a == 0, edges.step, -edges.step) == 1).all()


def test_one_label_has_no_borders() -> None:
    points, normals = plane((0, 0, 1), (0, 0, 0.5))
    edges = find_edges(np.ones(LEFT.shape, np.int32), points, normals, reach_px=3)
    assert len(edges.a) == 0
    contact, front = tabulate(edges, 1)
    assert not contact.any()
    assert not front.any()
