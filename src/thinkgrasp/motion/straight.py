"""The straight pieces of a grasp, in joint space: in along the approach, and up with what was grasped."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.motion import ur5e
from thinkgrasp.motion.robotiq_2f85 import tip_reach

Float = NDArray[np.float64]

SPACING_M = 0.01
_TURN = 2 * np.pi
_HALF_TURN = np.array([0, 0, 0, 0, 0, np.pi])
_JUMP_RAD = 0.4
"""Between two samples 1 cm apart, a joint that turns farther passes a singular pose."""


@dataclass(frozen=True, eq=False)
class StraightGrasps:
    """Joint paths of G ways to reach a grasp: pre-grasp, straight in, grasp, straight up."""

    grasp: NDArray[np.intp]
    """(G,) index of the grasp that each belongs to."""
    paths: Float
    """(G, S, 6) [rad]."""
    at_grasp: int
    """Sample of the grasp itself."""

    def __len__(self) -> int:
        return len(self.grasp)

    def of(self, grasp: int) -> StraightGrasps:
        """Return the ways to reach one of the grasps."""
        own = self.grasp == grasp
        return StraightGrasps(self.grasp[own], self.paths[own], self.at_grasp)


def straight_grasps(
    T_base_tcp: Float, opening_m: Float, standoff_m: float, lift_m: float, q_near: Float, spacing_m: float = SPACING_M
) -> StraightGrasps:
    """Find all ways to carry out grasps by straight moves within joint limits, without changing the branch.

    A two-finger gripper grasps the same turned by half a turn, so both are looked at.
    Ways that start nearest to `q_near` come first.

    Args:
        T_base_tcp: (N, 4, 4) grasps, the gripper right on the flange.
        opening_m: (N,) at which the fingertips are where the grasp says [m].
        standoff_m: Length of the way in.
        lift_m: Length of the way up.
        q_near: (6,) whole turns are chosen so that the pre-grasp is near to this [rad].
        spacing_m: Between two samples.
    """
    n_in, n_up = (max(int(np.ceil(length / spacing_m - 1e-9)), 1) for length in (standoff_m, lift_m))
    back = standoff_m * (1 - np.arange(n_in + 1) / n_in)
    up = np.concatenate([np.zeros(n_in + 1), lift_m * np.arange(1, n_up + 1) / n_up])
    back = np.concatenate([back, np.zeros(n_up)])

    T = flange_poses(T_base_tcp, opening_m)
    index = np.flatnonzero(np.isfinite(ur5e.inverse(T)[..., 0]).any(axis=1))
    along = np.repeat(T[index][:, None], len(back), axis=1)
    along[:, :, :3, 3] -= back[:, None] * along[:, :, :3, 2]
    along[:, :, 2, 3] += up

    q = ur5e.inverse(along.reshape(-1, 4, 4)).reshape(len(index), len(back), 8, 6).swapaxes(1, 2)
    index, q = np.repeat(index, 8), q.reshape(-1, len(back), 6)
    whole = np.isfinite(q).all(axis=(1, 2))
    index, q = np.tile(index[whole], 2), np.concatenate([q[whole], q[whole] + _HALF_TURN])
    q = np.unwrap(q, axis=1)
    q += (ur5e.LIMITS.nearest_to(q_near, q[:, 0]) - q[:, 0])[:, None]
    smooth = np.abs(np.diff(q, axis=1)).max(axis=(1, 2), initial=0.0) < _JUMP_RAD * spacing_m / SPACING_M
    good = smooth & ur5e.LIMITS.contain(q).all(axis=1)
    order = np.argsort(np.abs(q[good, 0] - q_near).max(axis=1), kind="stable")
    return StraightGrasps(index[good][order], q[good][order], n_in)


def straight_up(q_start: Float, height_m: float) -> Float:
    """Return the joint path (S, 6) [rad] from q_start (6,) straight up, as far as it goes within limits."""
    T = np.repeat(ur5e.forward(q_start)[None], round(height_m / SPACING_M) + 1, axis=0)
    T[:, 2, 3] += SPACING_M * np.arange(len(T))
    q = ur5e.inverse(T)
    q += _TURN * np.round((q_start - q) / _TURN)
    branch = int(np.argmin(np.nan_to_num(np.abs(q[0] - q_start).max(axis=1), nan=np.inf)))
    path = q[:, branch]
    path[0] = q_start
    path = path[: int(np.argmin(np.append(np.isfinite(path).all(axis=1), False)))]
    path = np.unwrap(path, axis=0)
    steady = (np.abs(np.diff(path, axis=0)).max(axis=1, initial=0.0) < _JUMP_RAD) & ur5e.LIMITS.contain(path[1:])
    return path[: 1 + int(np.argmin(np.append(steady, False)))]


def flange_poses(T_base_tcp: Float, opening_m: Float) -> Float:
    """Return T_base_flange (N, 4, 4) for fingertip poses (N, 4, 4) at openings (N,) or () [m]."""
    T = np.array(T_base_tcp, np.float64)
    T[:, :3, 3] -= np.reshape(tip_reach(opening_m), (-1, 1)) * T[:, :3, 2]
    return T
