"""Is the grasp on the target, within the opening, and where the robot may work?"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from thinkgrasp.errors import ConfigError
from thinkgrasp.gripper import Gripper
from thinkgrasp.types import Grasps, Scene, Segment


class TargetCheck:
    """Drop grasps whose TCP is not on the target: the crop may hold several things.

    Args:
        max_distance_px: How far the projected TCP may lie from the mask, in an image 640 px wide; scales with width.
        before_m: How far the TCP may float before the nearest visible part of the target.
        behind_m: How far it may lie behind the farthest visible part.

    Raises:
        ConfigError: A limit is negative or not finite.
    """

    def __init__(self, *, max_distance_px: float = 8.0, before_m: float = 0.02, behind_m: float = 0.06) -> None:
        for name, value in (("max_distance_px", max_distance_px), ("before_m", before_m), ("behind_m", behind_m)):
            if not (np.isfinite(value) and value >= 0):
                raise ConfigError(f"target check: {name} must be at least 0, got {value}")
        self.max_distance_px = max_distance_px
        self.before_m = before_m
        self.behind_m = behind_m

    def keep(self, scene: Scene, target: Segment, grasps: Grasps, gripper: Gripper) -> NDArray[np.bool_]:
        """Return (N,) True where the TCP projects into the target's box and near its mask, at its depth."""
        keep = np.asarray(grasps.positions[:, 2] > 1e-3)
        index = np.flatnonzero(keep)
        if len(index) == 0:
            return keep
        position = grasps.positions[index].astype(np.float64)
        pixel = scene.frame.camera.project(position)
        x0, y0, x1, y1 = target.box_xyxy
        ok = np.asarray((pixel >= [x0, y0]).all(axis=1) & (pixel <= [x1 - 1, y1 - 1]).all(axis=1))

        away = ndimage.distance_transform_edt(~target.mask[y0:y1, x0:x1])
        near = np.rint(pixel[ok] - [x0, y0]).astype(np.intp)
        limit = self.max_distance_px * max(scene.frame.camera.width / 640, 1)
        ok[ok] = np.asarray(away)[near[:, 1], near[:, 0]] <= limit

        z = scene.points[y0:y1, x0:x1, 2][target.mask[y0:y1, x0:x1]]
        z = z[np.isfinite(z)]
        if len(z):
            first, last = np.quantile(z, [0.02, 0.98])
            ok &= (position[:, 2] >= first - self.before_m) & (position[:, 2] <= last + self.behind_m)
        keep[index] = ok
        return keep


class WidthCheck:
    """Drop grasps that need another opening than the gripper has."""

    def keep(self, scene: Scene, target: Segment, grasps: Grasps, gripper: Gripper) -> NDArray[np.bool_]:
        """Return (N,) True where the opening is within the gripper's range."""
        widths = grasps.widths.astype(np.float64)
        return (widths >= gripper.min_width_m) & (widths <= gripper.max_width_m)


class WorkspaceCheck:
    """Drop grasps out of reach, outside the workspace mask, below the support or approaching from below.

    Args:
        min_distance_m: Nearest TCP to the camera.
        max_distance_m: Farthest TCP from the camera.
        max_height_m: Highest TCP above the support.
        max_tilt_deg: Largest angle between the approach and straight down into the support.

    Raises:
        ConfigError: The limits are not ordered.
    """

    def __init__(
        self,
        *,
        min_distance_m: float = 0.1,
        max_distance_m: float = 2.5,
        max_height_m: float = 1.0,
        max_tilt_deg: float = 95.0,
    ) -> None:
        if not (0 <= min_distance_m < max_distance_m and max_height_m > 0 and 0 < max_tilt_deg <= 180):
            raise ConfigError(
                "workspace check: need 0 <= min_distance_m < max_distance_m, max_height_m > 0, "
                "0 < max_tilt_deg <= 180; "
                f"got {min_distance_m}, {max_distance_m}, {max_height_m}, {max_tilt_deg}"
            )
        self.min_distance_m = min_distance_m
        self.max_distance_m = max_distance_m
        self.max_height_m = max_height_m
        self.max_tilt_deg = max_tilt_deg

    def keep(self, scene: Scene, target: Segment, grasps: Grasps, gripper: Gripper) -> NDArray[np.bool_]:
        """Return (N,) True where the TCP is within the limits and projects into the image and its workspace mask."""
        position = grasps.positions.astype(np.float64)
        distance = np.linalg.norm(position, axis=1)
        keep = (distance >= self.min_distance_m) & (distance <= self.max_distance_m) & (position[:, 2] > 1e-3)
        if scene.support is not None:
            height = scene.support.height(position)
            keep &= (height > 0) & (height <= self.max_height_m)
            down = -(grasps.rotations[:, :, 2] @ scene.support.normal)
            keep &= down >= np.cos(np.deg2rad(self.max_tilt_deg)) - 1e-6
        camera = scene.frame.camera
        index = np.flatnonzero(keep)
        pixel = np.rint(camera.project(position[index])).astype(np.intp)
        inside = np.asarray(((pixel >= 0) & (pixel < [camera.width, camera.height])).all(axis=1))
        if scene.frame.workspace is not None:
            inside[inside] = scene.frame.workspace[pixel[inside, 1], pixel[inside, 0]]
        keep[index] = inside
        return keep
