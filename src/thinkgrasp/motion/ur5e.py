"""Kinematics of the Universal Robots UR5e in closed form.

Base frame: as the maker defines it, origin at the middle of the mounting plane, z up out of the base, x such that the
arm at zero angles is stretched out along -x. The ROS description's `base_link` is this frame turned by half a turn
about z. Flange frame: the maker's tool frame, z out of the flange. Joints in order: shoulder pan, shoulder lift, elbow,
wrist 1, wrist 2, wrist 3.

References:
    Universal Robots, "DH parameters for calculations of kinematics and dynamics" (UR5e).
    Hawkins, "Analytic inverse kinematics for the Universal Robots UR-5/UR-10 arms", Georgia Tech 2013.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import InputError
from thinkgrasp.motion.limits import JointLimits

Float = NDArray[np.float64]

D1, D4, D5, D6 = 0.1625, 0.1333, 0.0997, 0.0996
A2, A3 = -0.425, -0.3922

DH = (
    (0.0, D1, np.pi / 2),
    (A2, 0.0, 0.0),
    (A3, 0.0, 0.0),
    (0.0, D4, np.pi / 2),
    (0.0, D5, -np.pi / 2),
    (0.0, D6, 0.0),
)
"""Denavit-Hartenberg (a [m], d [m], alpha [rad]) per joint: d along z, then a and the turn alpha about x."""

_DH_A, _DH_D, _ALPHA = np.array(DH).T
_COS_ALPHA, _SIN_ALPHA = np.round(np.cos(_ALPHA)), np.round(np.sin(_ALPHA))

LIMITS = JointLimits(
    lower=np.deg2rad([-360.0, -190, -160, -360, -360, -360]),
    upper=np.deg2rad([360.0, 10, 160, 360, 360, 360]),
    velocity=np.full(6, np.pi),
    acceleration=np.full(6, 10.0),
    jerk=np.full(6, 500.0),
)
"""The maker's ranges (360 degrees, elbow 180) and speed (180 degrees/s), with two ranges narrowed to what is of use on
a table: the upper arm stays less than 10 degrees below horizontal, and the elbow short of folding the forearm into it.
The maker gives no acceleration or jerk; these move the arm from rest to full speed in a third of a second."""

_SIGNS = np.array([(shoulder, wrist, elbow) for shoulder in (1, -1) for wrist in (1, -1) for elbow in (1, -1)], float)
_ROUNDING = 1e-12
_WRIST_ALIGNED = 1e-10


def link_frames(q: NDArray[np.floating]) -> Float:
    """Return the frames (..., 6, 4, 4) of the six links in the base frame, at joint angles q (..., 6) [rad]."""
    q = np.asarray(q, np.float64)
    cos, sin = np.cos(q), np.sin(q)
    step = np.zeros((*q.shape, 4, 4))
    step[..., 0, 0], step[..., 0, 1], step[..., 0, 2] = cos, -sin * _COS_ALPHA, sin * _SIN_ALPHA
    step[..., 1, 0], step[..., 1, 1], step[..., 1, 2] = sin, cos * _COS_ALPHA, -cos * _SIN_ALPHA
    step[..., 2, 1], step[..., 2, 2] = _SIN_ALPHA, _COS_ALPHA
    step[..., 0, 3], step[..., 1, 3], step[..., 2, 3], step[..., 3, 3] = _DH_A * cos, _DH_A * sin, _DH_D, 1
    for i in range(1, 6):
        step[..., i, :, :] = step[..., i - 1, :, :] @ step[..., i, :, :]
    return step


def forward(q: NDArray[np.floating]) -> Float:
    """Return T_base_flange (..., 4, 4) at joint angles q (..., 6) [rad]."""
    return link_frames(q)[..., 5, :, :]


def inverse(T_base_flange: NDArray[np.floating]) -> Float:
    """Find all joint angles that put the flange at each pose.

    The branch, in order: shoulder +-, wrist +-, elbow +-; the last changes fastest. Along a path that stays clear of
    singular poses a branch is continuous up to whole turns. Where wrist 2 is straight (its sine is 0), wrist 1 and
    wrist 3 turn about one axis and wrist 3 is set to 0.

    Args:
        T_base_flange: (N, 4, 4) rigid transforms.

    Returns:
        (N, 8, 6) [rad], each in -pi..pi; all six are NaN where the branch does not reach. Ranges are not looked at;
        `LIMITS.nearest_to` does.

    Raises:
        InputError: Not a batch of 4x4 matrices.
    """
    T = np.asarray(T_base_flange, np.float64)
    if T.ndim != 3 or T.shape[1:] != (4, 4):
        raise InputError(f"inverse kinematics takes transforms of shape (N, 4, 4), got {T.shape}")
    shoulder, wrist, elbow = _SIGNS.T
    x6, y6, z6, o6 = (T[:, :3, k, None] for k in range(4))  # each (N, 3, 1), against the 8 branches

    x5, y5 = o6[:, 0] - D6 * z6[:, 0], o6[:, 1] - D6 * z6[:, 1]
    q1 = np.arctan2(y5, x5) + np.pi / 2 + shoulder * _arccos(D4 / np.maximum(np.hypot(x5, y5), _ROUNDING))
    c1, s1 = np.cos(q1), np.sin(q1)

    # Components of the flange's axes along the axis z1 of the joints 2, 3 and 4.
    x, y, z = (a[:, 0] * s1 - a[:, 1] * c1 for a in (x6, y6, z6))
    sine = np.hypot(x, y)
    q5 = np.arctan2(wrist * sine, z)
    q6 = np.where(sine > _WRIST_ALIGNED, np.arctan2(-wrist * y, wrist * x), 0.0)

    # z4 = -(sin q6 x6 + cos q6 y6); along x1 = (c1, s1, 0) and y1 = (0, 0, 1) it is (sin q234, -cos q234).
    z4 = -(np.sin(q6)[:, None] * x6 + np.cos(q6)[:, None] * y6)
    q234 = np.arctan2(z4[:, 0] * c1 + z4[:, 1] * s1, -z4[:, 2])
    o4 = o6 - D6 * z6 - D5 * z4
    px, py = o4[:, 0] * c1 + o4[:, 1] * s1, o4[:, 2] - D1
    q3 = elbow * _arccos((px * px + py * py - A2 * A2 - A3 * A3) / (2 * A2 * A3))
    q2 = np.arctan2(py, px) - np.arctan2(A3 * np.sin(q3), A2 + A3 * np.cos(q3))
    q = np.stack([q1, q2, q3, q234 - q2 - q3, q5, q6], axis=-1)
    q -= 2 * np.pi * np.round(q / (2 * np.pi))
    return np.where(np.isfinite(q).all(axis=-1, keepdims=True), q, np.nan)


def _arccos(c: Float) -> Float:
    """Arc cosine; NaN outside -1..1, but for rounding errors."""
    return np.arccos(np.where(np.abs(c) <= 1 + _ROUNDING, np.clip(c, -1, 1), np.nan))
