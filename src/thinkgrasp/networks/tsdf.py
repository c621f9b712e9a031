"""The truncated signed distance field of one or several depth views: what volumetric networks look at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import InputError
from thinkgrasp.types import CameraIntrinsics

Float = NDArray[np.float32]

TRUNCATION_VOXELS = 4
"""Distances are cut off here."""
_FAR = 0.98
_BORDER_PX = np.float32(1e-4)


@dataclass(frozen=True, eq=False)
class Tsdf:
    """A cube of voxels; the centre of voxel (i, j, k) lies at (i + 0.5, j + 0.5, k + 0.5) voxels from its corner."""

    values: Float
    """(N, N, N) signed distance along the ray, mean of the views, in truncations: -1..1, positive = outside."""
    weights: Float
    """(N, N, N) number of views that saw the voxel."""

    def grid(self) -> Float:
        """Return the network's input (N, N, N): 0.5 at the surface, more outside, 0 where unseen, deep, or far away."""
        near = (self.weights > 0) & (self.values >= -_FAR) & (self.values < _FAR)
        return np.where(near, (self.values.astype(np.float64) + 1) / 2, 0).astype(np.float32)


def fuse(
    depth: NDArray[np.floating] | Sequence[NDArray[np.floating]],
    cameras: CameraIntrinsics | Sequence[CameraIntrinsics],
    T_camera_task: NDArray[np.floating],
    *,
    length_m: float,
    resolution: int,
    max_depth_m: float = 2.0,
) -> Tsdf:
    """Fuse depth views into the field of one cube.

    Sums and products are those of Open3D's UniformTSDFVolume in float32, in its order, so that the result is the same
    bit for bit: the nearest pixel, no interpolation, distances along the ray, every view with weight 1.

    Args:
        depth: Along the optical axis, V images (H, W) [m] of any sizes; 0, negative or not finite = no return.
        cameras: One for all views, or one each.
        T_camera_task: Cube to camera, (V, 4, 4); the cube's corner is its origin.
        length_m: Side of the cube.
        resolution: Voxels per side.
        max_depth_m: What is farther is no return.

    Raises:
        InputError: Shapes disagree, or there is no view.

    References:
        Curless and Levoy, A volumetric method for building complex models from range images, SIGGRAPH 1996; checked
        against Open3D 0.19.0.
    """
    views = [cameras] * len(depth) if isinstance(cameras, CameraIntrinsics) else list(cameras)
    images = all(image.ndim == 2 for image in depth)
    if not images or len(depth) == 0 or T_camera_task.shape != (len(depth), 4, 4) or len(views) != len(depth):
        raise InputError(
            f"a TSDF needs depth (V, H, W), transforms (V, 4, 4) and one camera or V, with V >= 1; "
            f"got {[image.shape for image in depth]}, {T_camera_task.shape} and {len(views)} cameras"
        )
    voxel = np.float32(length_m / resolution)
    truncation = np.float32(TRUNCATION_VOXELS * (length_m / resolution))
    values = np.zeros((resolution,) * 3, np.float32)
    weights = np.zeros((resolution,) * 3, np.float32)
    for image, camera, T in zip(depth, views, T_camera_task, strict=True):
        if image.shape != (camera.height, camera.width):
            raise InputError(f"depth is {image.shape[::-1]} but the camera is {camera.width}x{camera.height}")
        distance = _signed_distance(
            image.astype(np.float32), camera, T.astype(np.float32), voxel, resolution, max_depth_m
        )
        seen = distance > -truncation
        inverse = np.float32(1) / truncation
        t = np.minimum(np.float32(1), distance[seen] * inverse)
        w = weights[seen]
        values[seen] = (values[seen] * w + t) / (w + np.float32(1))
        weights[seen] = w + np.float32(1)
    return Tsdf(values, weights)


def _signed_distance(
    depth: Float, camera: CameraIntrinsics, T: Float, voxel: np.float32, resolution: int, max_depth_m: float
) -> Float:
    """Distance (N, N, N) [m] along the ray from each voxel's centre to what its pixel shows; -inf where unseen."""
    fx, fy, cx, cy = (np.float32(v) for v in (camera.fx, camera.fy, camera.cx, camera.cy))
    half = voxel / np.float32(2)
    along = half + voxel * np.arange(resolution, dtype=np.float32)
    steps = np.empty((3, resolution, resolution, resolution), np.float32)
    for axis in range(3):
        level = (T[axis, 0] * along)[:, None] + (T[axis, 1] * along)[None]
        steps[axis, :, :, 0] = level + T[axis, 2] * half + T[axis, 3]
        steps[axis, :, :, 1:] = T[axis, 2] * voxel
    X, Y, Z = np.add.accumulate(steps, axis=3)

    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        u = X * fx / Z + cx + np.float32(0.5)
        v = Y * fy / Z + cy + np.float32(0.5)
        inside = (Z > 0) & (u >= _BORDER_PX) & (u < np.float32(camera.width) - _BORDER_PX)
        inside &= (v >= _BORDER_PX) & (v < np.float32(camera.height) - _BORDER_PX)
    u, v, Z = u[inside].astype(np.intp), v[inside].astype(np.intp), Z[inside]
    d = depth[v, u]
    with np.errstate(invalid="ignore"):
        measured = (d > 0) & (d < max_depth_m)
    across = (u.astype(np.float32) - cx) * (np.float32(1) / fx)
    down = (v.astype(np.float32) - cy) * (np.float32(1) / fy)
    distance = np.full((resolution,) * 3, -np.inf, np.float32)
    distance[inside] = np.where(
        measured, (d - Z) * np.sqrt(across * across + down * down + np.float32(1)), np.float32(-np.inf)
    )
    return distance
