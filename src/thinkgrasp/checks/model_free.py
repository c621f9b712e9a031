"""The model-free collision detector of the GraspNet baseline: how much of a simple gripper is full of points?

Its gripper is fixed: fingers 1 cm thick and 6 cm long, a palm 1 cm thick, and the way it came. It tolerates a little of
the scene inside, by share of volume; the check `collision` tolerates nothing, and knows the real gripper.

References:
    graspnet-baseline (commit 280c215), collision_detector.py, against whose results the golden data were made; the code
    is our own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from thinkgrasp.errors import ConfigError, InputError
from thinkgrasp.gripper import Gripper
from thinkgrasp.types import Grasps, Scene, Segment

Float = NDArray[np.float64]

FINGER_THICKNESS_M, FINGER_LENGTH_M, FINGER_BREADTH_M = 0.01, 0.06, 0.02
_GRASPS_PER_BLOCK = 256


def averaged_voxels(points: NDArray[np.floating], voxel_m: float) -> Float:
    """Return the mean (M, 3) of the points (N, 3) in each occupied cell, of a grid that starts half a cell early.

    Raises:
        InputError: The cloud is so large that its cells cannot be counted.
    """
    points = np.asarray(points, np.float64)
    if len(points) == 0:
        return np.zeros((0, 3))
    cell = np.floor((points - (points.min(axis=0) - voxel_m / 2)) / voxel_m)
    size = cell.max(axis=0) + 1
    if not np.prod(size) < 2**62:
        raise InputError(f"a cloud over {np.ptp(points, axis=0)} m has too many cells of {voxel_m} m")
    flat = (cell @ [size[1] * size[2], size[2], 1]).astype(np.int64)
    _, index = np.unique(flat, return_inverse=True)
    count = np.bincount(index)
    return np.stack([np.bincount(index, weights=points[:, axis]) / count for axis in range(3)], axis=1)


@dataclass(frozen=True, eq=False)
class Occupancy:
    """How full of points the parts of the gripper are, for N grasps."""

    parts: Float
    """(5, N) share of the volume of everything, left finger, right finger, palm, and the way behind it."""
    between: Float
    """(N,) share of the volume between the fingers; NaN where the opening is 0."""


def occupancy(
    voxels: Float, rotations: Float, positions: Float, widths: Float, depths: Float, voxel_m: float, approach_m: float
) -> Occupancy:
    """Measure how full of points the gripper is at grasps in the nets' convention.

    Args:
        voxels: (M, 3) one point for each occupied cell [m].
        rotations: (N, 3, 3) columns: approach, closing, along the fingers' breadth.
        positions: (N, 3) seeds [m].
        widths: (N,) openings [m].
        depths: (N,) from the seed to the fingertips along the approach [m].
        voxel_m: Side of a cell.
        approach_m: Length of the way behind the palm, at least 1 cm.
    """
    approach_m = max(approach_m, FINGER_THICKNESS_M)
    parts, between = np.zeros((5, len(widths))), np.zeros(len(widths))
    h, t, length = FINGER_BREADTH_M, FINGER_THICKNESS_M, FINGER_LENGTH_M
    behind = length + t + approach_m
    middles = positions + (depths - behind / 2)[:, None] * rotations[:, :, 0]
    reach = np.linalg.norm([np.full_like(widths, behind / 2), widths / 2 + t, np.full_like(widths, h / 2)], axis=0)
    tree = KDTree(voxels)
    for start in range(0, len(widths), _GRASPS_PER_BLOCK):
        block = slice(start, start + _GRASPS_PER_BLOCK)
        near = tree.query_ball_point(middles[block], reach[block] + 1e-6)
        n = np.array([len(found) for found in near])
        g = np.repeat(np.arange(start, start + len(n)), n)
        local = voxels[np.concatenate(near).astype(np.intp)] - positions[g]
        x, y, z = np.einsum("ki,kij->jk", local, rotations[g])
        half, d = widths[g] / 2, depths[g]
        slab = (z > -h / 2) & (z < h / 2)
        beside = slab & (x > d - length) & (x < d)
        across = slab & (np.abs(y) < half + t)
        inside = np.stack(
            [
                beside & (y > -half - t) & (y < -half),
                beside & (y > half) & (y < half + t),
                across & (x > d - length - t) & (x <= d - length),
                across & (x > d - behind) & (x <= d - length - t),
            ]
        )
        full = [inside.any(axis=0), *inside, beside & (y >= -half) & (y <= half)]
        counts = [np.bincount(g[f] - start, minlength=len(n)) for f in full]
        parts[:, block], between[block] = counts[:5], counts[5]
    finger = np.full_like(widths, h * length * t)
    palm, way = h * (widths + 2 * t) * t, h * (widths + 2 * t) * approach_m
    cells = np.stack([2 * finger + palm + way, finger, finger, palm, way]) / voxel_m**3
    with np.errstate(divide="ignore", invalid="ignore"):
        return Occupancy(parts / (cells + 1e-6), between / (h * length * widths / voxel_m**3))


class ModelFreeCollisionCheck:
    """Drop grasps whose simple gripper is too full of the scene's points, as the GraspNet baseline does.

    The full cloud counts, thinned to one averaged point per cell. A cell is a point: with the settings here, one point
    is too much for openings below 4.3 cm, and two are above.

    Args:
        voxel_m: Side of the cells.
        approach_m: So much of the way behind the palm counts as well.
        max_share: The largest share of the gripper's cells that may be occupied.
        min_between: The least share of the cells between the fingers that must be; 0 switches this off.

    Raises:
        ConfigError: A setting is out of range.
    """

    def __init__(
        self, *, voxel_m: float = 0.01, approach_m: float = 0.05, max_share: float = 0.01, min_between: float = 0.0
    ) -> None:
        if not (0 < voxel_m < 0.1 and 0 <= approach_m < 1 and 0 <= max_share < 1 and 0 <= min_between < 1):
            raise ConfigError(
                "model-free collision check: need 0 < voxel_m < 0.1, 0 <= approach_m < 1, 0 <= max_share < 1, "
                f"0 <= min_between < 1; got {voxel_m}, {approach_m}, {max_share}, {min_between}"
            )
        self.voxel_m = voxel_m
        self.approach_m = approach_m
        self.max_share = max_share
        self.min_between = min_between

    def keep(self, scene: Scene, target: Segment, grasps: Grasps, gripper: Gripper) -> NDArray[np.bool_]:
        """Return (N,) True where the gripper is empty enough."""
        if len(grasps) == 0:
            return np.ones(0, bool)
        points = scene.cloud()
        found = occupancy(
            averaged_voxels(points, self.voxel_m),
            grasps.rotations[:, :, [2, 0, 1]].astype(np.float64),
            grasps.positions.astype(np.float64),
            grasps.widths.astype(np.float64),
            np.zeros(len(grasps)),
            self.voxel_m,
            self.approach_m,
        )
        keep = found.parts[0] <= self.max_share
        return keep & ~(found.between < self.min_between) if self.min_between else keep
