"""How an arm is mounted: where its base stands in the world, and where the gripper sits on its flange."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import ConfigError
from thinkgrasp.geometry import invert

Float = NDArray[np.float64]

_UPRIGHT = 1e-4


@dataclass(frozen=True, eq=False)
class ArmMount:
    """Two constant transforms; both turn about z only.

    Raises:
        ConfigError: A transform is not rigid, the base does not stand upright, or the gripper is not mounted straight
            out of the flange.
    """

    T_world_base: Float = field(default_factory=lambda: np.eye(4))
    """(4, 4) the maker's base frame in the world, whose z = 0 is the table top."""
    T_flange_gripper: Float = field(default_factory=lambda: np.eye(4))
    """(4, 4) where the gripper's own flange is on the arm's: a coupling's thickness along z, and a turn about z."""

    def __post_init__(self) -> None:
        for name, T in (("T_world_base", self.T_world_base), ("T_flange_gripper", self.T_flange_gripper)):
            if T.shape != (4, 4) or not np.isfinite(T).all() or not np.allclose(T[3], [0, 0, 0, 1]):
                raise ConfigError(f"arm mount: {name} must be a finite 4x4 matrix with the last row 0 0 0 1")
            R = T[:3, :3]
            if not np.allclose(R @ R.T, np.eye(3), atol=1e-3) or np.linalg.det(R) < 0:
                raise ConfigError(f"arm mount: the rotation of {name} must be orthonormal and right-handed")
            if abs(R[2, 2] - 1) > _UPRIGHT:
                raise ConfigError(
                    f"arm mount: {name} may turn about z only (arms on walls and ceilings, and bent couplings, are not "
                    f"supported); its z axis is {np.round(R[:, 2], 4).tolist()}"
                )
        if not np.allclose(self.T_flange_gripper[:2, 3], 0, atol=1e-6):
            raise ConfigError("arm mount: T_flange_gripper may move along z only")

    @property
    def coupling_m(self) -> float:
        """How far the gripper's flange lies before the arm's."""
        return float(self.T_flange_gripper[2, 3])

    @staticmethod
    def yaw(T: Float) -> float:
        """Return the turn about z [rad] of a transform (4, 4)."""
        return float(np.arctan2(T[1, 0], T[0, 0]))

    def in_base(self, T_world_tcp: Float) -> Float:
        """Return fingertip poses (..., 4, 4) in the base frame, as if the gripper sat right on the flange."""
        return invert(self.T_world_base) @ T_world_tcp @ invert(self.T_flange_gripper)

    def in_world(self, T_base_flange: Float) -> Float:
        """Return T_world_gripper (..., 4, 4), the gripper's own flange, for T_base_flange (..., 4, 4)."""
        return self.T_world_base @ T_base_flange @ self.T_flange_gripper
