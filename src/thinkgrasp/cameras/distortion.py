"""Lens distortion of live cameras: from images as they come to those of a pinhole, which the pipeline works on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from thinkgrasp.errors import InputError
from thinkgrasp.types import CameraIntrinsics

Float = NDArray[np.float64]

MODELS = ("none", "brown_conrady", "modified_brown_conrady", "inverse_brown_conrady")
"""Names of the RealSense SDK. All but the first are the radial and tangential terms of Brown and Conrady; they differ
in whether the tangential terms are taken before or after the radial ones."""


@dataclass(frozen=True)
class Lens:
    """A camera's distortion: a model's name, and its coefficients k1, k2, p1, p2, k3.

    Raises:
        InputError: No such model, or not five finite coefficients.
    """

    model: str = "none"
    coefficients: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise InputError(f"lens distortion {self.model!r} is not supported; allowed are {', '.join(MODELS)}")
        if len(self.coefficients) != 5 or not np.isfinite(self.coefficients).all():
            raise InputError(f"a lens needs five finite coefficients, got {self.coefficients}")

    @property
    def is_pinhole(self) -> bool:
        """Whether images are those of a pinhole as they come."""
        return self.model == "none" or not any(self.coefficients)

    def distort(self, xy: Float) -> Float:
        """Return where the lens puts ideal image coordinates (..., 2), on the plane at z = 1.

        References:
            librealsense `rsutil.h`, projection of a point to a pixel.
        """
        if self.is_pinhole:
            return xy
        k1, k2, p1, p2, k3 = self.coefficients
        x, y = xy[..., 0], xy[..., 1]
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        far_x, far_y = x * radial, y * radial
        if self.model == "brown_conrady":
            tx, ty = x, y
        else:
            tx, ty = far_x, far_y
        dx = far_x + 2 * p1 * tx * ty + p2 * (r2 + 2 * tx * tx)
        dy = far_y + 2 * p2 * tx * ty + p1 * (r2 + 2 * ty * ty)
        return np.stack([dx, dy], axis=-1)


class Rectifier:
    """Makes pinhole images of a camera's; size and intrinsics stay.

    Args:
        camera: Intrinsics of the images [px].
        lens: Their distortion.
    """

    def __init__(self, camera: CameraIntrinsics, lens: Lens) -> None:
        self._source: Float | None = None
        if not lens.is_pinhole:
            v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float64)
            ideal = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy], axis=-1)
            seen = lens.distort(ideal)
            self._source = np.stack([seen[..., 1] * camera.fy + camera.cy, seen[..., 0] * camera.fx + camera.cx])

    def color(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return a colour image (H, W, 3) as a pinhole would see it; black where the lens saw nothing."""
        if self._source is None:
            return image
        planes = [ndimage.map_coordinates(image[..., c], self._source, order=1, cval=0) for c in range(3)]
        return np.stack(planes, axis=-1).astype(np.uint8)

    def depth(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return depth (H, W) [m] as a pinhole would see it, without mixing near and far; 0 where nothing was seen."""
        if self._source is None:
            return image
        return np.asarray(ndimage.map_coordinates(image, self._source, order=0, cval=0.0), np.float32)
