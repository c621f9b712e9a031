"""Where simulated cameras stand and how they see: published fields of view, poses, rays. Pure numpy."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import ConfigError, InputError
from thinkgrasp.geometry import make_transform
from thinkgrasp.types import CameraIntrinsics

Float = NDArray[np.float64]

_FOV_DEG = {"l515": (70.0, 55.0), "d455": (87.0, 58.0)}
"""Horizontal and vertical field of view of the depth stream."""
SIZES = ((640, 480), (320, 240), (224, 224))
"""Image sizes (width, height) of `camera` [px]."""

DEFAULT_EYE = (0.86, 0.0, 0.55)
DEFAULT_TARGET = (0.50, 0.0, 0.02)

SIDE_EYE = (0.50, -0.40, 0.55)
FILM_EYE, FILM_TARGET = (0.98, -0.72, 0.66), (0.33, 0.14, 0.12)


@dataclass(frozen=True, eq=False)
class CameraView:
    """A pinhole camera at a place in the world.

    Raises:
        InputError: T_world_camera is no rigid (4, 4) transform.
    """

    intrinsics: CameraIntrinsics
    T_world_camera: Float
    """(4, 4) optical frame (x right, y down, z forward) to world."""

    def __post_init__(self) -> None:
        T = self.T_world_camera
        rigid = T.shape == (4, 4) and np.isfinite(T).all()
        if not (rigid and np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-6) and np.linalg.det(T[:3, :3]) > 0):
            raise InputError("a view needs T_world_camera as a rigid 4x4 transform: rotation, translation, 0 0 0 1")

    @property
    def eye(self) -> Float:
        """(3,) optical centre in the world [m]."""
        return self.T_world_camera[:3, 3]

    @cached_property
    def rays(self) -> Float:
        """(H*W, 3) directions in the world, row by row, scaled so that a point is eye + depth * ray."""
        c, R = self.intrinsics, self.T_world_camera[:3, :3]
        x = (np.arange(c.width) - c.cx) / c.fx
        y = (np.arange(c.height) - c.cy) / c.fy
        return (x[None, :, None] * R[:, 0] + (y[:, None, None] * R[:, 1] + R[:, 2])).reshape(-1, 3)


def look_at(
    eye: tuple[float, float, float],
    target: tuple[float, float, float],
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> Float:
    """Return T_world_camera (4, 4) of a camera at `eye` whose optical axis meets `target` [m].

    Args:
        eye: Optical centre in the world.
        target: Point in the middle of the image.
        up: World direction that points up in the image.

    Raises:
        InputError: Eye and target coincide, or `up` is along the line of sight.
    """
    forward = np.asarray(target, np.float64) - np.asarray(eye, np.float64)
    distance = np.linalg.norm(forward)
    if distance < 1e-9:
        raise InputError(f"eye and target coincide at {eye}")
    z = forward / distance
    x = np.cross(z, np.asarray(up, np.float64))
    size = np.linalg.norm(x)
    if size < 1e-9 * np.linalg.norm(up) or size == 0:
        raise InputError(f"up {up} is along the line of sight from {eye} to {target}; choose another direction")
    x /= size
    return make_transform(np.stack([x, np.cross(z, x), z], axis=1), np.asarray(eye, np.float64))


def camera(model: str, size_wh: tuple[int, int] = (640, 480)) -> CameraIntrinsics:
    """Return the intrinsics of an RGB-D camera whose colour is aligned to its depth.

    The depth field of view is that of the data sheets: L515 70 x 55 deg (Intel RealSense LiDAR Camera L515 data sheet),
    D455 87 x 58 deg (Intel RealSense D400 series data sheet). Pixels are square and the vertical field of view is kept;
    4:3 images are the centred crop of the sensor's width, 224x224 is the centred square of 640x480, scaled.

    Args:
        model: "l515" or "d455".
        size_wh: One of SIZES.

    Raises:
        ConfigError: No such model or size.
    """
    if model not in _FOV_DEG:
        raise ConfigError(f"no camera model {model!r}; allowed are {', '.join(sorted(_FOV_DEG))}")
    if size_wh not in SIZES:
        allowed = ", ".join(f"{w}x{h}" for w, h in SIZES)
        raise ConfigError(f"no image size {size_wh[0]}x{size_wh[1]} for {model}; allowed are {allowed}")
    width, height = size_wh
    focal = height / 2 / math.tan(math.radians(_FOV_DEG[model][1]) / 2)
    return CameraIntrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def default_view(model: str = "l515", size_wh: tuple[int, int] = (640, 480)) -> CameraView:
    """Return the view that faces the robot across the table and holds the whole workspace."""
    return CameraView(camera(model, size_wh), look_at(DEFAULT_EYE, DEFAULT_TARGET))


def side_view(model: str = "l515", size_wh: tuple[int, int] = (640, 480)) -> CameraView:
    """Return the view across the table from the side opposite the bin, for what the default view does not show."""
    return CameraView(camera(model, size_wh), look_at(SIDE_EYE, DEFAULT_TARGET))


def film_view() -> CameraView:
    """Return the view that shows arm, table and bin, for videos."""
    return CameraView(camera("d455", (320, 240)), look_at(FILM_EYE, FILM_TARGET))
