"""Would the two fingers hold what is between them?"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.checks.cloud import BlockedCloud, near_points
from thinkgrasp.contacts import closure_score, contact_angles, force_closure_score, friction_of_angle, smallest_friction
from thinkgrasp.errors import ConfigError
from thinkgrasp.geometry import voxel_downsample
from thinkgrasp.gripper import Gripper
from thinkgrasp.types import Grasps, Scene, Segment

__all__ = [
    "ForceClosureCheck",
    "closure_score",
    "contact_angles",
    "force_closure_score",
    "friction_of_angle",
    "smallest_friction",
]


class ForceClosureCheck:
    """Drop grasps with a score below `min_score`, and grasps that would close on nothing.

    A generator that scores by force closure reports 0 for pairs that do not close at mu = 1; those go here. A network
    may score on another scale, so what the scene says is asked too: between the fingers, at least `min_points` points
    of the cloud, thinned to 3 mm, must lie within the pads' reach.

    Args:
        min_score: Smallest score that passes.
        min_points: Points that must lie between the fingers; 0 switches the question off.

    Raises:
        ConfigError: A limit is out of range.
    """

    def __init__(self, *, min_score: float = 0.05, min_points: int = 2) -> None:
        if not (0 <= min_score <= 1 and min_points >= 0):
            raise ConfigError(
                f"force closure check: need 0 <= min_score <= 1 and min_points >= 0, got {min_score}, {min_points}"
            )
        self.min_score = min_score
        self.min_points = min_points

    def keep(self, scene: Scene, target: Segment, grasps: Grasps, gripper: Gripper) -> NDArray[np.bool_]:
        """Return (N,) True where the score suffices and something lies between the fingers."""
        keep = grasps.scores >= self.min_score
        alive = np.flatnonzero(keep)
        if self.min_points == 0 or len(alive) == 0:
            return keep
        asked = grasps[alive]
        high = np.zeros((len(asked), 3))
        high[:, 0] = asked.widths / 2
        high[:, 1] = gripper.finger_breadth_m / 2
        low = -high
        low[:, 2] = -gripper.finger_length_m
        x0, y0, x1, y1 = target.box_xyxy
        window = scene.points[y0:y1, x0:x1].reshape(-1, 3)
        if scene.frame.others is not None:
            window = np.concatenate([window, scene.frame.others.points])
        points = near_points(window, asked, float(np.linalg.norm([gripper.max_width_m, gripper.finger_length_m])))
        cloud = BlockedCloud.of(points[voxel_downsample(points, 0.003)], 0.02)
        index, _ = cloud.inside(asked, low, high)
        keep[alive] = np.bincount(index, minlength=len(asked)) >= self.min_points
        return keep
