"""What stands still around the robot: the layout that planner, reach check and simulator share.

World frame: the robot's base on the table plane, z up, x forward to the workspace.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

WORKSPACE_M = ((0.276, 0.724), (-0.224, 0.224))
"""Extent of the workspace along x and y, as in the published layouts."""


@dataclass(frozen=True)
class StaticBox:
    """A box that does not move, with sides along the world's axes."""

    name: str
    center_m: tuple[float, float, float]
    half_m: tuple[float, float, float]


@dataclass(frozen=True)
class Bin:
    """An open box that stands on the table; inner extent along x and y, and the height of its walls."""

    x_m: tuple[float, float]
    y_m: tuple[float, float]
    height_m: float
    wall_m: float = 0.01

    def contains(self, point_m: NDArray[np.float64]) -> bool:
        """Whether a world point (3,) lies inside, or not more than one wall's height above the rim."""
        x, y, z = (float(c) for c in point_m)
        return self.x_m[0] <= x <= self.x_m[1] and self.y_m[0] <= y <= self.y_m[1] and -0.02 <= z <= 2 * self.height_m

    @property
    def walls(self) -> tuple[StaticBox, ...]:
        """The four walls."""
        (x0, x1), (y0, y1), t, h = self.x_m, self.y_m, self.wall_m / 2, self.height_m / 2
        x, y, rx, ry = (x0 + x1) / 2, (y0 + y1) / 2, (x1 - x0) / 2 + 2 * t, (y1 - y0) / 2
        return (
            StaticBox("bin_right", (x, y0 - t, h), (rx, t, h)),
            StaticBox("bin_left", (x, y1 + t, h), (rx, t, h)),
            StaticBox("bin_near", (x0 - t, y, h), (t, ry, h)),
            StaticBox("bin_far", (x1 + t, y, h), (t, ry, h)),
        )


BIN = Bin((0.25, 0.65), (0.45, 0.75), 0.12)
TABLE = StaticBox("table", (0.35, 0.10, -0.02), (0.70, 0.70, 0.02))
MOUNT = (
    StaticBox("mount_pole", (0.98, 0.0, 0.375), (0.015, 0.015, 0.375)),
    StaticBox("mount_beam", (0.93, 0.0, 0.64), (0.06, 0.015, 0.015)),
)
STATICS: tuple[StaticBox, ...] = (TABLE, *BIN.walls, *MOUNT)
HOME_RAD = (-2.28, -1.39, 1.03, -1.21, -1.57, -2.28)
"""Joint angles between attempts: over the bin's near edge, out of the camera's view."""
