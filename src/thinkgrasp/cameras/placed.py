"""A camera whose place is known: on a stand by its calibration, or on the arm by where the arm is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.cameras.calibration import Calibration
from thinkgrasp.errors import InputError
from thinkgrasp.geometry import apply, deproject
from thinkgrasp.interfaces import Camera
from thinkgrasp.types import Frame

Float = NDArray[np.float64]

MOVED_M, MOVED_RAD = 0.001, 0.003
"""A camera on the arm may move by this much while it looks."""
INTRINSICS_SHARE = 0.01
"""By which focal length and principal point may differ from the camera file's."""


class PlacedCamera:
    """Gives a camera's frames their pose, and the mask of where grasping is allowed.

    Args:
        camera: What looks.
        pose: Returns T_world_camera (4, 4) now.
        workspace_m: (2, 3) lowest and highest corner of the box, world [m], where grasping is allowed;
            None = everywhere.
        calibration: What the camera file says; frames of other intrinsics are refused.
    """

    def __init__(
        self,
        camera: Camera,
        pose: Callable[[], Float],
        *,
        workspace_m: Float | None = None,
        calibration: Calibration | None = None,
    ) -> None:
        self.camera = camera
        self._pose = pose
        self._workspace = workspace_m
        self._calibration = calibration

    def read(self) -> Frame:
        """Return the next frame with its pose.

        Raises:
            InputError: The camera moved while it looked, or its intrinsics are not those of the camera file.
        """
        before = self._pose()
        frame = self.camera.read()
        after = self._pose()
        if self._calibration is not None:
            _check_intrinsics(frame, self._calibration)
        moved = float(np.linalg.norm(after[:3, 3] - before[:3, 3]))
        turned = float(np.arccos(np.clip((np.trace(before[:3, :3].T @ after[:3, :3]) - 1) / 2, -1, 1)))
        if not (moved <= MOVED_M and turned <= MOVED_RAD):
            raise InputError(
                f"the arm moved by {moved * 1e3:.1f} mm and {np.degrees(turned):.1f} deg while its camera "
                "looked; it has to "
                "stand still"
            )
        placed = replace(frame, T_world_camera=after.copy())
        if self._workspace is None:
            return placed
        points = apply(after, deproject(frame.depth, frame.camera).astype(np.float64))
        with np.errstate(invalid="ignore"):
            inside = ((points > self._workspace[0]) & (points < self._workspace[1])).all(axis=-1)
        return replace(placed, workspace=inside if frame.workspace is None else inside & frame.workspace)


def _check_intrinsics(frame: Frame, calibration: Calibration) -> None:
    size = (frame.camera.width, frame.camera.height)
    if calibration.size_wh is not None and calibration.size_wh != size:
        raise InputError(
            f"the camera file is for {calibration.size_wh[0]}x{calibration.size_wh[1]}, but the camera gives "
            f"{size[0]}x{size[1]}; calibrate at the size that you work with"
        )
    for name in ("fx", "fy", "cx", "cy"):
        filed, seen = float(getattr(calibration, name)), float(getattr(frame.camera, name))
        if abs(filed - seen) > INTRINSICS_SHARE * frame.camera.width:
            raise InputError(
                f"the camera file says {name} = {filed:.1f} px, but the camera {seen:.1f} px: is it the "
                "file of this camera?"
            )
