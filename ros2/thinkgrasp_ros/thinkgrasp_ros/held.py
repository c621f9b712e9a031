"""How large what is held may be: a box in the gripper's frame, from what was seen of it before it was taken."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.geometry import apply, invert, make_transform
from thinkgrasp_ros.interface import Transform

_GAP_M = 0.01
"""Between the fingers, points farther apart than this along them are of two things."""
_ABOVE_M = 0.01
"""What lies nearer to the lowest point around may be what the thing stands on."""
_BELOW_M = 0.003
"""Lower than the fingertips by this is lower."""
_LEAST_M = 0.02
"""Sides of the box, at least; so much is between the fingertips."""


@dataclass(frozen=True, eq=False)
class HeldBox:
    """A box that what is held does not reach beyond, as far as was seen."""

    middle: NDArray[np.float64]
    """(3,) [m], in the TCP's frame."""
    sides: NDArray[np.float64]
    """(3,) [m], along its axes."""

    def outside(self, points: NDArray[np.float64], T_world_tcp: Transform, margin_m: float) -> NDArray[np.float64]:
        """Return those of the world's points (N, 3) that are farther than that from the box along one of its axes."""
        T_world_box = T_world_tcp @ make_transform(np.eye(3), self.middle)
        beyond = np.abs(apply(invert(T_world_box), points)) - self.sides / 2
        return points[beyond.max(axis=1, initial=-np.inf) > margin_m]


def held_box(cloud: NDArray[np.floating], T_world_tcp: Transform, width_m: float, within_m: float) -> HeldBox:
    """Return the box around what is between the fingers and joined to it there, down to the lowest point around.

    Where nothing lower than the fingertips was seen, all that was seen is the thing's own top: it may reach down as far
    as points count.

    Args:
        cloud: What was seen (N, 3) [m], world, z up.
        T_world_tcp: Of the grasp (4, 4).
        width_m: Opening with which the fingers came; beyond it to the sides nothing is taken for a part of the thing.
        within_m: Points farther from the TCP do not count.
    """
    near = np.asarray(cloud, np.float64)
    near = near[np.linalg.norm(near - T_world_tcp[:3, 3], axis=1) <= within_m]
    T_tcp_world = invert(T_world_tcp)
    local = apply(T_tcp_world, near)
    between = np.abs(local[:, 0]) <= width_m / 2
    low = near[:, 2].min(initial=np.inf)
    if low < T_world_tcp[2, 3] - _BELOW_M:
        between &= near[:, 2] > low + _ABOVE_M
    else:
        low = T_world_tcp[2, 3] - within_m
    first, last = -_reach(-local[between, 1]), _reach(local[between, 1])
    own = between & (local[:, 1] >= first) & (local[:, 1] <= last)
    feet = near[own]
    feet[:, 2] = low
    core = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]) * _LEAST_M / 2
    everything = np.concatenate([local[own], apply(T_tcp_world, feet), core])
    lowest, highest = everything.min(axis=0), everything.max(axis=0)
    return HeldBox((lowest + highest) / 2, highest - lowest)


def _reach(y: NDArray[np.floating]) -> float:
    """How far values go on from 0 upwards without a gap."""
    steps = np.concatenate([[0.0], np.sort(y[y >= 0])])
    gap = np.flatnonzero(np.diff(steps) > _GAP_M)
    return float(steps[gap[0]] if len(gap) else steps[-1])
