"""What a robot arm's joints may do."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import ConfigError

Float = NDArray[np.float64]

_TURN = 2 * np.pi


@dataclass(frozen=True, eq=False)
class JointLimits:
    """Bounds of n revolute joints, each array (n,).

    Raises:
        ConfigError: The arrays differ in length, a range is empty, or a rate is not positive and finite.
    """

    lower: Float
    """[rad]."""
    upper: Float
    """[rad]."""
    velocity: Float
    """[rad/s]."""
    acceleration: Float
    """[rad/s^2]."""
    jerk: Float
    """[rad/s^3]."""

    def __post_init__(self) -> None:
        rates = (self.velocity, self.acceleration, self.jerk)
        if any(a.shape != self.lower.shape or a.ndim != 1 for a in (self.upper, *rates)):
            raise ConfigError("joint limits: lower, upper, velocity, acceleration and jerk need one value per joint")
        if not (self.lower < self.upper).all() or not all(np.isfinite(a).all() and (a > 0).all() for a in rates):
            raise ConfigError("joint limits: need lower < upper, and positive velocity, acceleration and jerk")

    def contain(self, q: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return (...,) True where all joints of q (..., n) [rad] are within their range; NaN is not."""
        return np.asarray(((q >= self.lower) & (q <= self.upper)).all(axis=-1))

    def nearest_to(self, reference: NDArray[np.floating], q: NDArray[np.floating]) -> Float:
        """Turn each joint of q (..., n) by whole turns to come as near to `reference` as its range allows.

        Args:
            reference: Where to be near to, broadcast against q [rad].
            q: Joint angles [rad]; NaN stays NaN.

        Returns:
            (..., n) [rad]; a configuration without an equivalent in range is NaN in all its joints.
        """
        q = np.asarray(q, np.float64)
        least, most = np.ceil((self.lower - q) / _TURN), np.floor((self.upper - q) / _TURN)
        turned = q + _TURN * np.clip(np.round((reference - q) / _TURN), least, most)
        return np.where((least <= most).all(axis=-1, keepdims=True), turned, np.nan)
