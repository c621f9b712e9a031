"""Which grasp to take: the k x k cell of the target's box, and the best of the N grasps nearest to it.

References:
    Qian et al., ThinkGrasp, CoRL 2024, section 3.3: preferred location in a 3x3 grid over the cropped target; the best
    scoring of the 10 grasps nearest to it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.types import Array, BoxXYXY, Grasps, Mask

FINGERS_M = 0.04
"""Length of the fingers that a thing may lie between."""
SAME_M, SAME_DEG = 0.015, 30.0
"""Grasps closer than this in place and orientation are one."""


def middle_cell(grid: int) -> int:
    """Return the cell in the middle of a grid; of the four around it where the grid is even, the first."""
    row = (grid - 1) // 2
    return row * grid + row + 1


def cell_box(box_xyxy: BoxXYXY, grid: int, cell: int) -> tuple[float, float, float, float]:
    """Return the sub-box of a cell, numbered row by row from 1 at the top-left to grid*grid.

    Raises:
        ValueError: The grid is not positive or the cell is outside 1..grid*grid.
    """
    if grid < 1 or not 1 <= cell <= grid * grid:
        raise ValueError(f"cell must be in 1..{grid * grid} for a {grid}x{grid} grid, got {cell}")
    x0, y0, x1, y1 = box_xyxy
    row, column = divmod(cell - 1, grid)
    w, h = (x1 - x0) / grid, (y1 - y0) / grid
    return x0 + column * w, y0 + row * h, x0 + (column + 1) * w, y0 + (row + 1) * h


def cell_center(box_xyxy: BoxXYXY, grid: int, cell: int) -> tuple[float, float]:
    """Return the centre (u, v) [px] of a cell of a half-open box; pixel centres are at integers."""
    x0, y0, x1, y1 = cell_box(box_xyxy, grid, cell)
    return (x0 + x1 - 1) / 2, (y0 + y1 - 1) / 2


def preferred_point(points: Array, mask: Mask, box_xyxy: BoxXYXY, grid: int, cell: int) -> NDArray[np.float64] | None:
    """Lift the centre of the chosen cell to 3-D; see `nearest_point`.

    Args:
        points: Organised cloud (H, W, 3) [m], camera frame; NaN = no return.
        mask: Target (H, W).
        box_xyxy: Its bounding box [px].
        grid: Cells per side.
        cell: 1..grid*grid, row by row.

    Returns:
        (3,) [m] in the camera frame; None when no masked pixel has depth.
    """
    return nearest_point(points, mask, cell_center(box_xyxy, grid, cell))


def nearest_point(points: Array, mask: Mask, at_px: tuple[float, float]) -> NDArray[np.float64] | None:
    """Lift a pixel (u, v) to 3-D.

    It need not lie on the object (a bowl's rim, a mug's handle), so the masked pixel with depth that is nearest to it
    in the image is taken.

    Returns:
        (3,) [m] in the camera frame; None when no masked pixel has depth.
    """
    v, u = np.nonzero(mask & np.isfinite(points[..., 2]))
    if len(u) == 0:
        return None
    nearest = int(np.argmin((u - at_px[0]) ** 2 + (v - at_px[1]) ** 2))
    return points[v[nearest], u[nearest]].astype(np.float64)


def rank_grasps(grasps: Grasps, point: NDArray[np.float64], n_nearest: int = 10) -> NDArray[np.intp]:
    """Order the `n_nearest` distinct grasps nearest to `point` (3,) [m] by score, best first.

    Of near-duplicates only the best counts, as after non-maximum suppression. A grasp is near to what its fingers reach
    around, so distance is measured to the line from the TCP back along the approach over FINGERS_M: a deep grasp is as
    near to a point of the surface as a shallow one.

    Ties in distance keep the lower index, ties in score the nearer grasp, so the result does not depend on chance.

    Raises:
        ValueError: n_nearest is not positive.
    """
    if n_nearest < 1:
        raise ValueError(f"n_nearest must be at least 1, got {n_nearest}")
    kept = distinct_grasps(grasps)
    back = point - grasps.positions[kept].astype(np.float64)
    approach = grasps.rotations[kept, :, 2].astype(np.float64)
    along = np.clip(np.einsum("ni,ni->n", back, approach), -FINGERS_M, 0)
    distance = np.linalg.norm(back - along[:, None] * approach, axis=1)
    nearest = kept[np.argsort(distance, kind="stable")[:n_nearest]]
    return nearest[np.argsort(-grasps.scores[nearest], kind="stable")]


def distinct_grasps(grasps: Grasps) -> NDArray[np.intp]:
    """Return the indices, ascending, of grasps that no better one resembles in place and orientation.

    The closing direction has no sign: a two-finger grasp turned by half a turn is the same.
    """
    order = np.argsort(-grasps.scores, kind="stable")
    position = grasps.positions[order].astype(np.float64)
    closing, approach = (grasps.rotations[order, :, axis].astype(np.float64) for axis in (0, 2))
    cos = np.cos(np.deg2rad(SAME_DEG))
    suppressed = np.zeros(len(order), np.bool_)
    for i in range(len(order)):
        if not suppressed[i]:
            rest = slice(i + 1, None)
            near = ((position[rest] - position[i]) ** 2).sum(axis=1) < SAME_M**2
            near &= (approach[rest] @ approach[i] > cos) & (np.abs(closing[rest] @ closing[i]) > cos)
            suppressed[rest] |= near
    return np.sort(order[~suppressed])
