"""A grasp in GraspNet's convention, which the paper's server answers in; the only place that converts to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.types import Decision

MIN_DEPTH_M, MAX_DEPTH_M = 0.01, 0.04
"""GraspNet's own range of `dep`."""
DEFAULT_DEPTH_M = 0.02
"""Where the cloud shows no surface between the fingers."""


@dataclass(frozen=True, eq=False)
class Pose:
    """A grasp in the camera frame; the fingertips are at `xyz + dep * rot[:, 0]`.

    References:
        [Fang2020] section 4; the answer of `realarm.py` in H-Freax/ThinkGrasp.
    """

    xyz: NDArray[np.float64]
    """(3,) [m] on the surface where the approach meets it, as near as `dep` allows."""
    rot: NDArray[np.float64]
    """(3, 3) columns: approach, closing, and what completes them."""
    dep: float
    """How far the fingertips reach past xyz [m]."""


def to_graspnet(decision: Decision) -> Pose | None:
    """Return the chosen grasp in GraspNet's convention; None where there is none."""
    grasp = decision.grasp
    if grasp is None:
        return None
    closing, across, approach = grasp.rotation.T
    dep = _reach(decision)
    return Pose(grasp.position - dep * approach, np.stack([approach, closing, across], axis=1), dep)


def _reach(decision: Decision) -> float:
    """Return how far past the surface between the fingers the tips are [m], within GraspNet's range."""
    grasp, target, points = decision.grasp, decision.target, decision.scene.points
    if grasp is None or target is None:
        return DEFAULT_DEPTH_M
    seen = points[target.mask & np.isfinite(points[..., 2])].astype(np.float64)
    local = (seen - grasp.position) @ grasp.rotation
    between = local[(np.abs(local[:, 0]) <= grasp.width_m / 2) & (np.abs(local[:, 1]) <= 0.01), 2]
    behind = -between[between < 0]
    return float(np.clip(behind.max(), MIN_DEPTH_M, MAX_DEPTH_M)) if len(behind) else DEFAULT_DEPTH_M
