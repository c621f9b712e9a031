"""The perceived cloud as a map of heights above the table: what the arm must keep out of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Float = NDArray[np.float64]


@dataclass(frozen=True)
class HeightMap:
    """A grid of vertices over the table along the world's x and y; heights between them are interpolated.

    The robot's own base lies outside of the default extent, so that a camera that sees it does not block the arm.
    """

    x_m: tuple[float, float] = (0.15, 1.05)
    y_m: tuple[float, float] = (-0.45, 0.80)
    spacing_m: float = 0.01
    lowest_m: float = 0.005
    """Points below are the table."""
    highest_m: float = 1.0
    """Points above are not obstacles of this table."""

    @property
    def shape(self) -> tuple[int, int]:
        """Vertices along y and x."""
        (x0, x1), (y0, y1) = self.x_m, self.y_m
        return round((y1 - y0) / self.spacing_m) + 1, round((x1 - x0) / self.spacing_m) + 1

    def heights(self, points_m: NDArray[np.floating]) -> Float:
        """Return the heights (shape) [m] of a surface that no point rises above, but for single outliers.

        A vertex is as high as the second highest point in the square of one spacing around it, and no lower than its
        eight neighbours: depth cameras see single points floating at edges, and nothing that is solid is one point.

        Args:
            points_m: (P, 3) in the world [m]; not finite ones are left out.
        """
        rows, columns = self.shape
        x, y, z = np.asarray(points_m).T
        with np.errstate(invalid="ignore"):
            near = np.flatnonzero((z > self.lowest_m) & (z < self.highest_m))
        column = np.rint((x[near] - self.x_m[0]) / self.spacing_m)
        row = np.rint((y[near] - self.y_m[0]) / self.spacing_m)
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        vertex = (row[inside] * columns + column[inside]).astype(np.intp)
        z = z[near][inside]
        order = np.lexsort((-z, vertex))
        vertex, z = vertex[order], z[order]
        second = np.zeros(len(vertex), bool)
        second[1:] = vertex[1:] == vertex[:-1]
        second[2:] &= vertex[2:] != vertex[:-2]
        heights = np.zeros(rows * columns)
        heights[vertex[second]] = z[second]
        return ndimage.maximum_filter(heights.reshape(rows, columns), size=3)

    def tops(self, heights: Float) -> tuple[NDArray[np.intp], Float]:
        """Return the flat index (K,) of all vertices above the table, and their positions (K, 3) in the world [m]."""
        index = np.flatnonzero(heights)
        row, column = np.divmod(index, self.shape[1])
        x, y = self.x_m[0] + column * self.spacing_m, self.y_m[0] + row * self.spacing_m
        return index, np.stack([x, y, heights.ravel()[index]], axis=1)
