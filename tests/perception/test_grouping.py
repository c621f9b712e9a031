"""Merging of patches: one surface with a print stays whole; folds and steps separate."""

from __future__ import annotations

import numpy as np
import pytest
from fakes.surfaces import WIDTH, Sheet, cylinder, pixels, plane, sheet, two_colors
from hypothesis import given
from hypothesis import strategies as st

from thinkgrasp.perception.grouping import MERGE_BELOW, Adjacency, merge_patches, patch_adjacency, patch_statistics
from thinkgrasp.perception.morphology import Labels
from thinkgrasp.perception.superpixels import superpixels

LEFT = pixels(lambda u, v: u < WIDTH // 2)
MIDDLE = pixels(lambda u, v: (v > 50) & (v < 90))


def groups(s: Sheet) -> Labels:
    """Cut and merge; return the groups (H, W), 1..m."""
    labels = superpixels(s.mask, s.points, s.normals, s.lab)
    patches = patch_statistics(labels, s.points, s.normals, s.lab)
    joined = merge_patches(len(patches.count), patch_adjacency(labels, s.points, s.normals, patches))
    return np.where(labels > 0, np.r_[-1, joined][labels] + 1, 0).astype(np.int32)


def shares(g: Labels, inside: np.ndarray) -> np.ndarray:
    """Return what share of an area each group has, largest first."""
    return np.sort(np.bincount(g[inside])[1:] / inside.sum())[::-1]


def main_group(g: Labels, inside: np.ndarray) -> int:
    return int(np.bincount(g[inside]).argmax())


@pytest.mark.parametrize(
    "colors",
    [((190, 36, 34), (240, 214, 150)), ((238, 236, 230), (196, 40, 36)), ((40, 90, 190), (230, 230, 226))],
    ids=["cracker box", "soup can", "blue and white"],
)
def test_a_printed_surface_is_one(colors: tuple[tuple[int, int, int], tuple[int, int, int]]) -> None:
    points, normals, mask = cylinder(0.06, 0.5)
    for surface in (
        sheet(points, normals, mask, two_colors(MIDDLE, *colors)),
        sheet(*plane((0, -1, -1), (0, 0, 0.6)), np.ones_like(LEFT), two_colors(LEFT, *colors)),
    ):
        assert shares(groups(surface), surface.mask)[0] > 0.97


def wedge(depth: float, rgb: tuple[tuple[int, int, int], tuple[int, int, int]]) -> Sheet:
    """Two faces that meet at a right angle on the middle column; `depth` < 0: the edge points at the camera."""
    sign = np.sign(depth)
    left, left_normal = plane((1, 0, -sign), (0, 0, 0.6))
    right, right_normal = plane((-1, 0, -sign), (0, 0, 0.6))
    points = np.where(LEFT[..., None], left, right)
    normals = np.where(LEFT[..., None], left_normal, right_normal)
    near = (points[..., 2] > 0.3) & (points[..., 2] < 1.2)
    return sheet(points, normals, near, two_colors(LEFT, *rgb))


GREY = (150, 150, 150)


def test_the_faces_of_one_box_are_one_thing() -> None:
    """An outward fold, both faces in one colour and in two."""
    for rgb in ((GREY, GREY), ((190, 36, 34), (240, 214, 150))):
        surface = wedge(-1.0, rgb)
        depth = surface.points[..., 2]
        assert depth[72, 96] < depth[72, 30], "the edge was meant to point at the camera"
        assert shares(groups(surface), surface.mask)[0] > 0.97


def test_two_boxes_that_touch_at_an_inward_fold_are_two() -> None:
    for rgb in ((GREY, GREY), ((186, 34, 36), (40, 90, 190))):
        surface = wedge(1.0, rgb)
        depth = surface.points[..., 2]
        assert depth[72, 96] > depth[72, 30], "the edge was meant to point away from the camera"
        g = groups(surface)
        sides = [LEFT & surface.mask, ~LEFT & surface.mask]
        first, second = (main_group(g, side) for side in sides)
        assert first != second
        for side, own in zip(sides, (first, second), strict=True):
            assert (g[side] == own).mean() > 0.95


def test_a_depth_step_separates() -> None:
    points, normals = plane((0, 0, 1), (0, 0, 1.0))
    z = np.where(LEFT, np.float32(0.6), np.float32(0.65))
    g = groups(sheet(points * z[..., None], normals, np.ones_like(LEFT)))
    assert main_group(g, LEFT) != main_group(g, ~LEFT)
    assert shares(g, LEFT)[0] > 0.97


def test_statistics_are_means() -> None:
    labels = np.where(LEFT, 1, 2).astype(np.int32)
    points, normals = plane((0, 0, 1), (0, 0, 0.5))
    lab = np.where(LEFT[..., None], np.float32(20), np.float32(60)) * np.ones(3, np.float32)
    normals = normals.copy()
    normals[::7] = np.nan
    patches = patch_statistics(labels, points, normals, lab)
    np.testing.assert_array_equal(patches.count, [LEFT.sum(), (~LEFT).sum()])
    np.testing.assert_allclose(patches.lab, [[20] * 3, [60] * 3])
    np.testing.assert_allclose(patches.normal, [[0, 0, -1]] * 2, atol=1e-6)
    np.testing.assert_allclose(patches.center[0], points[LEFT].mean(axis=0), atol=1e-5)


def chain(costs: list[float], lengths: list[float] | None = None) -> Adjacency:
    n = len(costs)
    return Adjacency(
        np.arange(n), np.arange(1, n + 1), np.array(lengths or [10.0] * n), np.array(costs, dtype=np.float64)
    )


def test_cheap_borders_join_and_dear_ones_do_not() -> None:
    joined = merge_patches(5, chain([0.1, 0.9, 0.2, MERGE_BELOW + 0.01]))
    np.testing.assert_array_equal(joined, [0, 0, 1, 1, 2])


def test_the_mean_over_the_common_border_counts() -> None:
    """Patch 2 has a short cheap and a long dear border with what patches 0 and 1 become."""
    long_dear = Adjacency(np.array([0, 0, 1]), np.array([1, 2, 2]), np.array([10.0, 5, 30]), np.array([0.0, 0.3, 0.95]))
    assert len(set(merge_patches(3, long_dear).tolist())) == 2
    short_dear = Adjacency(
        np.array([0, 0, 1]), np.array([1, 2, 2]), np.array([10.0, 30, 5]), np.array([0.0, 0.3, 0.95])
    )
    assert len(set(merge_patches(3, short_dear).tolist())) == 1


@given(st.lists(st.floats(0, 1), min_size=1, max_size=30))
def test_a_chain_breaks_exactly_at_its_dear_borders(costs: list[float]) -> None:
    joined = merge_patches(len(costs) + 1, chain(costs))
    np.testing.assert_array_equal(np.diff(joined) != 0, np.array(costs) >= MERGE_BELOW)
    np.testing.assert_array_equal(np.unique(joined), np.arange(joined.max() + 1))


def test_nothing_to_merge() -> None:
    none = Adjacency(np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros(0), np.zeros(0))
    np.testing.assert_array_equal(merge_patches(3, none), [0, 1, 2])
