"""The Robotiq 2F-85's linkage: how opening, crank angle and the fingertips' reach go together.

In a pinch the finger stays parallel to the palm and is carried by a crank, so that the fingertips move on an arc: they
reach 14 mm farther when closed than when open. Flange frame: z out of the flange, fingers closing along x.

References:
    Pivots, crank and pad of the public description (ros-industrial `robotiq_2f_85`, joints outer_knuckle, outer_finger,
    inner_finger and finger pad); the pad's thickness is set so that the stroke is 85 mm. Fully closed the tips then lie
    163.0 mm before the flange, and 149.1 mm when open; the maker's drawings say 162.8 mm closed.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thinkgrasp.errors import ContractError

STROKE_M = 0.085
PIVOT_X_M = 0.0306011
"""Crank pivot beside the middle plane."""
PIVOT_Z_M = 0.054904
CRANK_X_M, CRANK_Z_M = 0.0376, 0.0430
"""From the crank's pivot to the finger's, when fully open."""
PAD_X_M, PAD_Z_M = -0.0220203, 0.03242
"""From the finger's pivot to the middle of the pad."""
PAD_HALF_M = (PIVOT_X_M + CRANK_X_M + PAD_X_M - STROKE_M / 2, 0.011, 0.01875)
"""Half sides of the pad: thickness, breadth, length."""

_CRANK_M = float(np.hypot(CRANK_X_M, CRANK_Z_M))
_OPEN_RAD = float(np.arctan2(CRANK_X_M, CRANK_Z_M))
_PAD_FACE_M = PIVOT_X_M + PAD_X_M - PAD_HALF_M[0]
"""Half opening less the crank's share."""
CLOSED_RAD = _OPEN_RAD - float(np.arcsin(-_PAD_FACE_M / _CRANK_M))
"""Crank angle at which the pads meet; 0 = fully open."""


def crank_angle(opening_m: ArrayLike) -> NDArray[np.float64]:
    """Return the crank's angle [rad] for an opening (...) [m]; 0 = fully open.

    Raises:
        ContractError: An opening is outside 0..STROKE_M.
    """
    opening = np.asarray(opening_m, np.float64)
    if not np.all((opening >= -1e-9) & (opening <= STROKE_M + 1e-9)):
        raise ContractError(f"2F-85 opening must be within 0..{STROKE_M} m, got {opening}")
    return _OPEN_RAD - np.arcsin((opening / 2 - _PAD_FACE_M) / _CRANK_M)


def opening(crank_rad: ArrayLike) -> NDArray[np.float64]:
    """Return the opening (...) [m] between the pads at a crank angle (...) [rad]."""
    return 2 * (_PAD_FACE_M + _CRANK_M * np.sin(_OPEN_RAD - np.asarray(crank_rad, np.float64)))


def tip_reach(opening_m: ArrayLike) -> NDArray[np.float64]:
    """Return how far the fingertips' end lies before the flange [m], (...)."""
    angle = _OPEN_RAD - crank_angle(opening_m)
    return PIVOT_Z_M + _CRANK_M * np.cos(angle) + PAD_Z_M + PAD_HALF_M[2]


def flange_to_tip(opening_m: float) -> NDArray[np.float64]:
    """Return T_flange_tcp (4, 4) at an opening [m]: the TCP is midway between the fingertips' ends."""
    T = np.eye(4)
    T[2, 3] = float(tip_reach(opening_m))
    return T
