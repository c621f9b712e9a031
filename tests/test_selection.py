"""The cell and the top-N rule of the paper: properties over random boxes, masks and batches."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thinkgrasp.selection import FINGERS_M, cell_box, cell_center, middle_cell, preferred_point, rank_grasps
from thinkgrasp.types import Grasps

boxes = st.tuples(st.integers(0, 500), st.integers(0, 500), st.integers(1, 300), st.integers(1, 300)).map(
    lambda b: (b[0], b[1], b[0] + b[2], b[1] + b[3])
)
grids = st.integers(1, 7)


class TestCells:
    @given(boxes, grids)
    def test_cells_tile_the_box_row_by_row(self, box, grid):
        cells = [cell_box(box, grid, c) for c in range(1, grid * grid + 1)]
        assert cells[0][:2] == pytest.approx(box[:2])
        assert cells[-1][2:] == pytest.approx(box[2:])
        area = sum((x1 - x0) * (y1 - y0) for x0, y0, x1, y1 in cells)
        assert area == pytest.approx((box[2] - box[0]) * (box[3] - box[1]))
        for left, right in pairwise(cells):
            if right[0] > left[0]:
                assert (left[2], left[1]) == pytest.approx((right[0], right[1]))
            else:
                assert left[3] == pytest.approx(right[1])

    @given(boxes, grids, st.data())
    def test_the_centre_of_a_cell_lies_in_it(self, box, grid, data):
        cell = data.draw(st.integers(1, grid * grid))
        (u, v), (x0, y0, x1, y1) = cell_center(box, grid, cell), cell_box(box, grid, cell)
        assert x0 <= u + 0.5 <= x1
        assert y0 <= v + 0.5 <= y1

    def test_the_papers_numbering(self):
        box = (0, 0, 9, 9)
        assert [cell_center(box, 3, c) for c in (1, 3, 5, 7, 9)] == [(1, 1), (7, 1), (4, 4), (1, 7), (7, 7)]

    @pytest.mark.parametrize(("grid", "cell"), [(3, 0), (3, 10), (0, 1), (-1, 1)])
    def test_cells_outside_the_grid(self, grid, cell):
        with pytest.raises(ValueError, match="cell must be in"):
            cell_box((0, 0, 9, 9), grid, cell)


masks = st.integers(0, 2**32 - 1).map(lambda s: np.random.default_rng(s).random((12, 16)) < 0.3)


def cloud() -> np.ndarray:
    v, u = np.mgrid[:12, :16].astype(np.float32)
    return np.stack([u, v, np.full_like(u, 1.0)], axis=-1)


class TestPreferredPoint:
    @given(masks, st.integers(1, 4), st.data())
    def test_it_is_the_masked_point_nearest_to_the_cell(self, mask, grid, data):
        cell = data.draw(st.integers(1, grid * grid))
        point = preferred_point(cloud(), mask, (0, 0, 16, 12), grid, cell)
        if not mask.any():
            assert point is None
            return
        assert point is not None
        u, v = int(point[0]), int(point[1])
        assert mask[v, u]
        center = np.array(cell_center((0, 0, 16, 12), grid, cell))
        vs, us = np.nonzero(mask)
        assert np.hypot(*(point[:2] - center)) == pytest.approx(np.hypot(us - center[0], vs - center[1]).min())

    def test_pixels_without_depth_do_not_count(self):
        points = cloud()
        points[6, 8] = np.nan
        mask = np.zeros((12, 16), bool)
        mask[6, 8] = True
        assert preferred_point(points, mask, (8, 6, 9, 7), 3, 5) is None
        mask[0, 0] = True
        assert np.array_equal(preferred_point(points, mask, (0, 0, 9, 7), 3, 9), [0, 0, 1])


def batch(positions: np.ndarray, scores: np.ndarray) -> Grasps:
    n = len(positions)
    rotations = np.broadcast_to(np.eye(3, dtype=np.float32), (n, 3, 3))
    return Grasps(rotations, positions.astype(np.float32), np.full(n, 0.05, np.float32), scores.astype(np.float32))


batches = st.tuples(st.integers(0, 40), st.integers(0, 2**32 - 1)).map(
    lambda a: batch(
        np.random.default_rng(a[1]).uniform(-1, 1, (a[0], 3)),
        np.random.default_rng(a[1] + 1).integers(0, 5, a[0]) / 4,
    )
)


def to_fingers(grasps: Grasps) -> np.ndarray:
    """Distance from the origin to where the fingers are: from the TCP 4 cm back along the approach, here +z."""
    p = grasps.positions.astype(float)
    return np.hypot(np.hypot(p[:, 0], p[:, 1]), p[:, 2] - np.clip(p[:, 2], 0, FINGERS_M))


class TestRanking:
    @given(batches, st.integers(1, 15))
    def test_the_n_nearest_by_score(self, grasps, n):
        order = rank_grasps(grasps, np.zeros(3), n)
        assert len(order) == min(n, len(grasps)) == len(set(order.tolist()))
        distance = to_fingers(grasps)
        others = np.setdiff1d(np.arange(len(grasps)), order)
        if len(order) and len(others):
            assert distance[order].max() <= distance[others].min()
        scores = grasps.scores[order]
        assert (np.diff(scores) <= 0).all()
        ties = np.diff(scores) == 0
        assert (np.diff(distance[order])[ties] >= 0).all()

    @given(batches, st.integers(0, 2**32 - 1))
    def test_the_order_given_does_not_matter(self, grasps, seed):
        shuffled = np.random.default_rng(seed).permutation(len(grasps))
        a = grasps[rank_grasps(grasps, np.zeros(3))]
        b = grasps[shuffled][rank_grasps(grasps[shuffled], np.zeros(3))]
        assert np.array_equal(a.positions, b.positions)

    @given(batches)
    def test_one_nearest_ignores_the_score(self, grasps):
        order = rank_grasps(grasps, np.zeros(3), 1)
        if len(grasps):
            assert order[0] == np.argmin(to_fingers(grasps))

    def test_a_better_grasp_beyond_the_n_nearest_loses(self):
        grasps = batch(np.array([[0.1, 0, 0], [0.2, 0, 0], [0.5, 0, 0]]), np.array([0.2, 0.4, 1.0]))
        assert rank_grasps(grasps, np.zeros(3), 2).tolist() == [1, 0]
        assert rank_grasps(grasps, np.zeros(3), 3).tolist() == [2, 1, 0]

    def test_a_deep_grasp_is_as_near_as_a_shallow_one(self):
        grasps = batch(np.array([[0, 0, 0.03], [0, 0.02, 0]]), np.array([0.9, 0.8]))
        assert rank_grasps(grasps, np.zeros(3), 1).tolist() == [0]

    @pytest.mark.parametrize(
        ("shift_m", "turn_deg", "n"), [(0.01, 0, 1), (0.02, 0, 2), (0, 20, 1), (0, 40, 2), (0, 180, 1)]
    )
    def test_of_near_duplicates_the_best_counts(self, shift_m, turn_deg, n):
        a = np.deg2rad(turn_deg)
        turned = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
        two = batch(np.array([[0, 0, 0], [shift_m, 0, 0]]), np.array([0.5, 0.9]))
        two = replace(two, rotations=np.stack([np.eye(3), turned]).astype(np.float32))
        order = rank_grasps(two, np.zeros(3))
        assert len(order) == n
        assert order[0] == 1

    def test_n_must_be_positive(self):
        with pytest.raises(ValueError, match="n_nearest"):
            rank_grasps(batch(np.zeros((1, 3)), np.ones(1)), np.zeros(3), 0)


@pytest.mark.parametrize(("grid", "cell"), [(1, 1), (2, 1), (3, 5), (4, 6), (5, 13)])
def test_the_middle_cell_is_nearest_to_the_middle(grid, cell):
    assert middle_cell(grid) == cell
    u, v = cell_center((0, 0, 60 * grid, 60 * grid), grid, cell)
    assert max(abs(u - 30 * grid), abs(v - 30 * grid)) <= 31
