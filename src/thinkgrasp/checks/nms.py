"""Non-maximum suppression: of grasps that resemble one another, keep the best."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import ConfigError
from thinkgrasp.gripper import Gripper
from thinkgrasp.types import Grasps, Scene, Segment

DISTANCE_M, ANGLE_DEG = 0.03, 30.0
"""As in GraspNet's evaluation."""


def suppress(
    rotations: NDArray[np.floating],
    positions: NDArray[np.floating],
    scores: NDArray[np.floating],
    *,
    distance_m: float = DISTANCE_M,
    angle_deg: float = ANGLE_DEG,
    half_turn: bool = True,
) -> NDArray[np.intp]:
    """Return the indices of the grasps that no better kept one is near to in place and orientation, best first.

    Args:
        rotations: (N, 3, 3), approach in the last column.
        positions: (N, 3) [m].
        scores: (N,); of equal ones the first goes first.
        distance_m: Strictly nearer is near.
        angle_deg: Of the rotation between two grasps; strictly smaller is near.
        half_turn: Count a grasp turned by 180 degrees about its approach as the same, as it is for two fingers.

    References:
        grasp_nms 1.0.2, which knows no half turn; the code is our own.
    """
    order = np.argsort(-scores, kind="stable")
    R, p = rotations[order].astype(np.float64), positions[order].astype(np.float64)
    kept: list[int] = []
    alive = np.ones(len(order), bool)
    for i in range(len(order)):
        if not alive[i]:
            continue
        kept.append(i)
        rest = np.flatnonzero(alive[i + 1 :]) + i + 1
        rest = rest[np.linalg.norm(p[rest] - p[i], axis=1) < distance_m]
        along = np.einsum("nij,ij->nj", R[rest], R[i])
        trace = along.sum(axis=1)
        if half_turn:
            trace = np.maximum(trace, along[:, 2] - along[:, 0] - along[:, 1])
        angle = np.arccos((np.clip(trace, -1, 3) - 1) / 2)
        alive[rest[angle < np.deg2rad(angle_deg)]] = False
    return order[kept]


class SuppressionCheck:
    """Drop grasps that resemble a better one; after the other checks, so that none falls to one that is itself dropped.

    Args:
        distance_m: TCPs nearer than this ...
        angle_deg: ... and rotations closer than this are one grasp.
        half_turn: A grasp turned by 180 degrees about its approach is the same; False as in GraspNet's own.

    Raises:
        ConfigError: A limit is negative or not finite.
    """

    def __init__(self, *, distance_m: float = DISTANCE_M, angle_deg: float = ANGLE_DEG, half_turn: bool = True) -> None:
        if not (0 <= distance_m < 10 and 0 <= angle_deg <= 180):
            raise ConfigError(
                f"nms: need 0 <= distance_m < 10 and 0 <= angle_deg <= 180, got {distance_m} and {angle_deg}"
            )
        self.distance_m = distance_m
        self.angle_deg = angle_deg
        self.half_turn = half_turn

    def keep(self, scene: Scene, target: Segment, grasps: Grasps, gripper: Gripper) -> NDArray[np.bool_]:
        """Return (N,) True for the best of those that resemble one another."""
        keep = np.zeros(len(grasps), bool)
        keep[
            suppress(
                grasps.rotations,
                grasps.positions,
                grasps.scores,
                distance_m=self.distance_m,
                angle_deg=self.angle_deg,
                half_turn=self.half_turn,
            )
        ] = True
        return keep
