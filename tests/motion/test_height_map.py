from __future__ import annotations

import numpy as np

from thinkgrasp.motion.height_map import HeightMap

MAP = HeightMap((0.0, 0.2), (-0.1, 0.1), 0.01)


def height_at(points: np.ndarray, x: float, y: float) -> float:
    return MAP.heights(points)[round((y + 0.1) / 0.01), round(x / 0.01)]


def test_shape_is_y_by_x() -> None:
    assert HeightMap((0.0, 0.2), (-0.1, 0.4), 0.01).shape == (51, 21)


def test_no_point_rises_above_the_surface() -> None:
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(0.02, 0.18, 4000), rng.uniform(-0.08, 0.08, 4000), np.zeros(4000)])
    points[:, 2] = 0.05 + 0.3 * points[:, 0]
    heights = MAP.heights(np.repeat(points, 2, axis=0))
    row, column = (points[:, 1] + 0.1) / 0.01, points[:, 0] / 0.01
    r, c = np.floor(row).astype(int), np.floor(column).astype(int)
    lowest_corner = np.min([heights[r + i, c + j] for i in (0, 1) for j in (0, 1)], axis=0)
    assert (lowest_corner >= points[:, 2] - 1e-12).all()


def test_single_points_are_not_believed_but_two_are() -> None:
    point = np.array([[0.1, 0.0, 0.3]])
    assert height_at(point, 0.1, 0.0) == 0
    assert height_at(np.repeat(point, 2, axis=0), 0.1, 0.0) == 0.3
    assert height_at(np.array([[0.1, 0.0, 0.3], [0.1, 0.0, 0.1], [0.1, 0.0, 0.05]]), 0.1, 0.0) == 0.1


def test_table_ceiling_and_outside_are_left_out() -> None:
    points = np.array([[0.1, 0.0, 0.003], [0.1, 0.0, 2.0], [0.5, 0.0, 0.1], [0.1, -0.3, 0.1], [np.nan] * 3])
    assert not MAP.heights(np.repeat(points, 2, axis=0)).any()


def test_no_points_no_heights() -> None:
    assert not MAP.heights(np.zeros((0, 3))).any()
