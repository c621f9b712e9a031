"""Can the arm get there, straight in and straight up, without touching anything?"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import ConfigError, MissingDependency
from thinkgrasp.geometry import apply
from thinkgrasp.gripper import Gripper
from thinkgrasp.types import Grasps, Scene, Segment

if TYPE_CHECKING:
    from thinkgrasp.motion.arm import ArmMotion


class ReachCheck:
    """Drop grasps that the UR5e with its 2F-85 cannot carry out where it stands.

    A grasp passes when one branch of the inverse kinematics leads within joint limits from the pre-grasp straight to
    the grasp and straight up, the arm meeting nothing that stands still (table, bin, camera mount) nor the perceived
    cloud, and the pre-grasp being clear of everything. The gripper at the object is not looked at here: the collision
    check has done so against every single point. Grasps are looked at best first, until `max_kept` have passed. The
    rest is dropped too: what passes is promised to be reachable, and selection needs only so many to choose from.

    World coordinates are those of the motion's cell, z up out of the table; by default the robot's base is its origin.

    Args:
        standoff_m: Length of the straight way in.
        lift_m: Length of the straight way up.
        max_kept: Grasps to pass at most.
        motion: The arm and what stands still around it; default: the simulated cell's.

    Raises:
        ConfigError: A setting is out of range.
        MissingDependency: MuJoCo is not installed.
    """

    def __init__(
        self,
        *,
        standoff_m: float = 0.10,
        lift_m: float = 0.15,
        max_kept: int = 80,
        motion: ArmMotion | None = None,
    ) -> None:
        if max_kept < 1:
            raise ConfigError(f"reach check: max_kept must be at least 1, got {max_kept}")
        try:
            from thinkgrasp.motion.arm import ArmMotion
        except ModuleNotFoundError as error:
            raise MissingDependency("mujoco-core", "sim", "the reach check") from error
        self.motion = motion or ArmMotion(standoff_m=standoff_m, lift_m=lift_m)
        self.max_kept = max_kept

    def keep(self, scene: Scene, target: Segment, grasps: Grasps, gripper: Gripper) -> NDArray[np.bool_]:
        """Return (N,) True for the grasps that the arm can carry out.

        Raises:
            ConfigError: The frame does not say where the camera is.
        """
        from thinkgrasp.motion.robotiq_2f85 import STROKE_M

        keep = np.zeros(len(grasps), bool)
        if len(grasps) == 0:
            return keep
        T_world_camera = scene.frame.T_world_camera
        if T_world_camera is None:
            raise ConfigError(
                "the reach check needs to know where the camera is, and this frame has no T_world_camera; "
                "give it in camera.json, or leave the reach check out"
            )
        order = np.argsort(-grasps.scores, kind="stable")
        T_camera_tcp = np.tile(np.eye(4), (len(grasps), 1, 1))
        T_camera_tcp[:, :3, :3] = grasps.rotations[order]
        T_camera_tcp[:, :3, 3] = grasps.positions[order]
        opening_m = np.clip(grasps.widths[order].astype(np.float64), 0.0, STROKE_M)
        cloud = apply(T_world_camera, scene.cloud())
        start, T_world_tcp = self.motion.seen_at, T_world_camera @ T_camera_tcp
        keep[order] = self.motion.reaches(start, T_world_tcp, opening_m, cloud, at_most=self.max_kept)
        return keep
