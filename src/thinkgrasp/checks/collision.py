"""The opened gripper must not touch anything: neither the cloud nor the support, at the grasp or on the way there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.checks.cloud import BlockedCloud, near_points
from thinkgrasp.errors import ConfigError
from thinkgrasp.geometry import voxel_downsample
from thinkgrasp.gripper import Gripper
from thinkgrasp.types import Grasps, Scene, Segment


def body_boxes(grasps: Grasps, gripper: Gripper, extend_back_m: float = 0.0) -> NDArray[np.float64]:
    """Return the boxes (N, 3, 2, 3) of left finger, right finger and palm, each at its grasp's own width.

    `extend_back_m` lengthens every box backwards: what it sweeps on a straight approach of that length.
    """
    boxes = np.repeat(gripper.bodies(0.0)[None], len(grasps), axis=0)
    half = grasps.widths.astype(np.float64)[:, None] / 2
    boxes[:, 0, :, 0] -= half
    boxes[:, 1, :, 0] += half
    boxes[:, :, 0, 2] -= extend_back_m
    return boxes


class CollisionCheck:
    """Drop grasps whose fingers or palm meet the full cloud, at the grasp or on the approach.

    Every point of the frame counts, those that other cameras saw and the target's own included; only the space between
    the fingers may hold points. Most collisions are found on a cloud thinned to `voxel_m`; what survives is tested
    against every single point.

    Args:
        margin_m: Bodies are enlarged by this much on all sides. Above 2.6 mm (half the diagonal of a 3 mm voxel), no
            centre of an occupied voxel can lie in a body either.
        standoff_m: Length of the straight approach.
        voxel_m: Spacing of the thinned cloud.
        support_noise_m: Points of the support that lie no higher above its plane than this do not count: noise, which
            would keep fingers from all that is flat. The table clearance check looks after the support itself.

    Raises:
        ConfigError: A length is out of range.
    """

    def __init__(
        self,
        *,
        margin_m: float = 0.003,
        standoff_m: float = 0.10,
        voxel_m: float = 0.004,
        support_noise_m: float = 0.0,
    ) -> None:
        if not (0 <= margin_m < 0.05 and 0 <= standoff_m < 1 and 0 < voxel_m < 0.05 and 0 <= support_noise_m < 0.02):
            raise ConfigError(
                "collision check: need 0 <= margin_m < 0.05, 0 <= standoff_m < 1, 0 < voxel_m < 0.05, "
                f"0 <= support_noise_m < 0.02; got {margin_m}, {standoff_m}, {voxel_m}, {support_noise_m}"
            )
        self.support_noise_m = support_noise_m
        self.margin_m = margin_m
        self.standoff_m = standoff_m
        self.voxel_m = voxel_m

    def keep(self, scene: Scene, target: Segment, grasps: Grasps, gripper: Gripper) -> NDArray[np.bool_]:
        """Return (N,) True where the opened gripper and its approach are clear of all points."""
        keep = np.ones(len(grasps), bool)
        if len(grasps) == 0:
            return keep
        boxes = body_boxes(grasps, gripper, self.standoff_m)
        boxes[:, :, 0] -= self.margin_m
        boxes[:, :, 1] += self.margin_m
        reach = float(np.linalg.norm(np.abs(boxes).max(axis=(1, 2)), axis=1).max())
        points = near_points(self._counted(scene), grasps, reach)
        points = self._above_lowest_body(points, scene, grasps, boxes)
        if len(points) == 0:
            return keep
        thin = BlockedCloud.of(points[voxel_downsample(points, self.voxel_m)], 0.025)
        for body in range(3):
            alive = np.flatnonzero(keep)
            keep[alive[thin.hit(grasps[alive], boxes[alive, body, 0], boxes[alive, body, 1])]] = False
        alive = np.flatnonzero(keep)
        if len(alive) == 0:
            return keep
        full = BlockedCloud.of(points, 0.012)
        for body in range(3):
            alive = np.flatnonzero(keep)
            keep[alive[full.hit(grasps[alive], boxes[alive, body, 0], boxes[alive, body, 1])]] = False
        return keep

    def _counted(self, scene: Scene) -> NDArray[np.float32]:
        """The cloud (N, 3) without the support's noise."""
        if self.support_noise_m == 0 or scene.support is None:
            return scene.cloud()
        support, others = scene.support, scene.frame.others
        noise = support.inliers & (support.height(scene.points) <= self.support_noise_m)
        seen = scene.points[~noise & np.isfinite(scene.points[..., 2])]
        if others is None:
            return seen
        return np.concatenate([seen, others.points[support.height(others.points) > self.support_noise_m]])

    @staticmethod
    def _above_lowest_body(
        points: NDArray[np.float32], scene: Scene, grasps: Grasps, boxes: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """Leave out the points that lie below every body: most of the table."""
        if scene.support is None:
            return points
        lowest = lowest_corner(grasps, boxes, scene.support.normal) + scene.support.offset_m
        return points[scene.support.height(points) >= lowest.min() - 1e-6]


def lowest_corner(grasps: Grasps, boxes: NDArray[np.float64], up: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the smallest extent (N,) [m] along `up` (3,) of boxes (N, B, 2, 3) given in the grasps' frames."""
    axes = np.einsum("nij,i->nj", grasps.rotations.astype(np.float64), np.asarray(up, np.float64))
    low = np.minimum(axes[:, None] * boxes[:, :, 0], axes[:, None] * boxes[:, :, 1]).sum(axis=2)
    return grasps.positions.astype(np.float64) @ up + low.min(axis=1)


class TableClearanceCheck:
    """Drop grasps with any corner of fingers or palm closer than `margin_m` to the support.

    Without a support plane everything passes; the collision check still sees the table's points.

    Raises:
        ConfigError: The margin is negative or not finite.
    """

    def __init__(self, *, margin_m: float = 0.003) -> None:
        if not (np.isfinite(margin_m) and margin_m >= 0):
            raise ConfigError(f"table clearance check: margin_m must be at least 0, got {margin_m}")
        self.margin_m = margin_m

    def keep(self, scene: Scene, target: Segment, grasps: Grasps, gripper: Gripper) -> NDArray[np.bool_]:
        """Return (N,) True where every body stays above the support."""
        if scene.support is None or len(grasps) == 0:
            return np.ones(len(grasps), bool)
        lowest = lowest_corner(grasps, body_boxes(grasps, gripper), scene.support.normal) + scene.support.offset_m
        return lowest >= self.margin_m
