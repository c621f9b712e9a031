"""What a UR5e with a 2F-85 has to mind in every attempt, simulated or real: the tips' arc, the bin, the cloud."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import InputError
from thinkgrasp.geometry import apply, deproject, make_transform
from thinkgrasp.motion.cell import Bin
from thinkgrasp.motion.robotiq_2f85 import tip_reach
from thinkgrasp.types import Frame, Scene

Float = NDArray[np.float64]

CLEARANCE_M = 0.007
"""Room that grasps leave between an open finger and the thing."""
FURTHER_M = 0.005
"""By how much a thing may be thinner than the grasp takes it for."""
MAX_RETREAT_M = 0.02
"""A grasp that would need more to stay above the table is none."""
TABLE_GAP_M = 0.001
TAKEN_M = 0.06
"""Points this near beside the fingers are what was taken, and leave with it."""
_YAWS = np.arange(12) * np.pi / 6
_LEAST_DROP_M, _MOST_DROP_M = 0.10, 0.28
"""How far above the bin's rim things are let go."""


def retreat_for_arc(T_world_tcp: Float, opening_m: float) -> float:
    """How far the flange has to stay back [m], as the tips reach farther the more they close.

    The grasp is meant for tips in contact; where the thing is a little thinner than thought, they must still not be
    pushed into the table.
    """
    contact = max(opening_m - 2 * CLEARANCE_M, 0.0)
    reach = float(tip_reach(contact) - tip_reach(opening_m))
    further = float(tip_reach(max(contact - FURTHER_M, 0.0)) - tip_reach(contact))
    down = -float(T_world_tcp[2, 2])
    into_table = further * max(down, 0.0) - (float(T_world_tcp[2, 3]) - TABLE_GAP_M)
    return reach + max(into_table, 0.0)


def over_bin(bin: Bin, taken_at_z_m: float) -> Float:
    """Fingertips (N, 4, 4) over the middle of a bin, pointing down, high enough for what was taken at that height."""
    z = taken_at_z_m + bin.height_m + 0.03
    z = np.clip(z, bin.height_m + _LEAST_DROP_M, bin.height_m + _MOST_DROP_M)
    at = np.array([np.mean(bin.x_m), np.mean(bin.y_m), z])
    turns = [
        np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])
        for c, s in zip(np.cos(_YAWS), np.sin(_YAWS), strict=True)
    ]
    return np.stack([make_transform(R, at) for R in turns])


def perceived_cloud(frame: Frame) -> Float:
    """Return the world points (P, 3) [m] that a frame shows, those of other cameras included.

    Raises:
        InputError: The frame's camera pose is unknown.
    """
    if frame.T_world_camera is None:
        raise InputError("the camera's pose is needed to plan a motion: T_world_camera is missing in the frame")
    points = Scene(frame, deproject(frame.depth, frame.camera)).cloud()
    return np.asarray(apply(frame.T_world_camera, points), np.float64)


def without_taken(cloud_m: Float, T_world_tcp: Float) -> Float:
    """Return the cloud (P, 3) without the points that leave with what was taken."""
    return cloud_m[np.linalg.norm(cloud_m[:, :2] - T_world_tcp[:2, 3], axis=1) > TAKEN_M]
