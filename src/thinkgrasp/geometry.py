"""Rigid transforms and point clouds: pure numpy, no state.

A transform `T_a_b` (4, 4) maps coordinates in b to coordinates in a; in a product the adjacent names cancel.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from thinkgrasp.errors import InputError
from thinkgrasp.types import Array, CameraIntrinsics

Float = NDArray[np.float64]


def make_transform(rotation: NDArray[np.floating], translation: NDArray[np.floating]) -> Float:
    """Return the (4, 4) transform of a rotation (3, 3) and a translation (3,)."""
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = translation
    return T


def invert(T: NDArray[np.floating]) -> Float:
    """Return the inverse (4, 4) of a rigid transform."""
    R = np.asarray(T[:3, :3], np.float64)
    return make_transform(R.T, -R.T @ T[:3, 3])


def apply(T: NDArray[np.floating], points: NDArray[np.floating]) -> NDArray[np.floating]:
    """Map points (..., 3) by a transform; the points' dtype is kept."""
    return points @ T[:3, :3].T.astype(points.dtype) + T[:3, 3].astype(points.dtype)


def quat_wxyz(rotation: NDArray[np.floating]) -> Float:
    """Return the unit quaternion (4,) w, x, y, z with w >= 0 of a rotation (3, 3).

    References:
        Bar-Itzhack 2000: the eigenvector of the largest eigenvalue; stable for every rotation.
    """
    m = np.asarray(rotation, np.float64)
    K = np.array(
        [
            [m[0, 0] + m[1, 1] + m[2, 2], 0, 0, 0],
            [m[2, 1] - m[1, 2], m[0, 0] - m[1, 1] - m[2, 2], 0, 0],
            [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], 0],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1]],
        ]
    )
    q = np.linalg.eigh(K, UPLO="L")[1][:, -1]
    return q if q[0] >= 0 else -q


def rotation_from_quat_wxyz(quat: NDArray[np.floating]) -> Float:
    """Return the rotation (3, 3) of a quaternion (4,) w, x, y, z; it need not be normalised."""
    w, x, y, z = np.asarray(quat, np.float64) / np.linalg.norm(quat)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def deproject(depth: Array, camera: CameraIntrinsics) -> Array:
    """Turn a depth image into an organised point cloud in the camera frame.

    Args:
        depth: Depth along the optical axis, (H, W) float32 [m]; 0, NaN or infinite = no return.
        camera: Pinhole intrinsics [px].

    Returns:
        (H, W, 3) float32 [m]; NaN where there was no return.

    Raises:
        InputError: The depth's size is not the camera's.
    """
    if depth.shape != (camera.height, camera.width):
        raise InputError(f"depth is {depth.shape[::-1]} but the camera is {camera.width}x{camera.height}")
    z = np.where((depth > 0) & (depth < np.inf), depth, np.float32(np.nan)).astype(np.float32)
    points = np.empty((*depth.shape, 3), np.float32)
    points[..., 0] = z * ((np.arange(camera.width, dtype=np.float32) - camera.cx) / camera.fx).astype(np.float32)
    points[..., 1] = (
        z * ((np.arange(camera.height, dtype=np.float32) - camera.cy) / camera.fy).astype(np.float32)[:, None]
    )
    points[..., 2] = z
    return points


def fit_plane(points: NDArray[np.floating]) -> tuple[Float, float]:
    """Fit a plane normal . p + offset = 0 to points (N, 3), N >= 3, by least squares.

    Returns:
        Unit normal (3,), pointing to the side of the origin (offset > 0), and the offset [m].
    """
    p = np.asarray(points, np.float64)
    center = p.mean(axis=0)
    q = p - center
    normal = np.linalg.eigh(q.T @ q)[1][:, 0]
    offset = -float(normal @ center)
    return (normal, offset) if offset >= 0 else (-normal, -offset)


def rotation_aligning(a: NDArray[np.floating], b: NDArray[np.floating]) -> Float:
    """Return the shortest rotation (3, 3) that takes unit vector a (3,) to unit vector b (3,)."""
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    v, c = np.cross(a, b), float(a @ b)
    if c < -1 + 1e-9:
        axis = np.cross(a, np.eye(3)[int(np.argmin(np.abs(a)))])
        axis /= np.linalg.norm(axis)
        return np.asarray(2 * np.outer(axis, axis) - np.eye(3), np.float64)
    K = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + K + K @ K / (1 + c)


def voxel_downsample(points: NDArray[np.floating], voxel_m: float) -> NDArray[np.intp]:
    """Return the index of one point (the first) per occupied voxel of points (N, 3)."""
    keys = np.floor((points - points.min(axis=0, initial=np.inf)) / voxel_m).astype(np.int64) if len(points) else points
    if len(points) == 0:
        return np.zeros(0, np.intp)
    size = keys.max(axis=0) + 1
    flat = (keys[:, 0] * size[1] + keys[:, 1]) * size[2] + keys[:, 2]
    return np.sort(np.unique(flat, return_index=True)[1])


def organised_normals(points: Array, camera: CameraIntrinsics, radius_px: int = 3, jump: float = 0.02) -> Array:
    """Estimate surface normals of an organised cloud without smoothing across depth edges.

    On a plane the inverse depth is linear in the pixel coordinates, so its gradient gives the normal exactly. The
    gradient is averaged over a window, leaving out neighbours across a depth edge.

    Args:
        points: (H, W, 3) [m], camera frame; NaN = no return.
        camera: Pinhole intrinsics [px].
        radius_px: Half width of the averaging window.
        jump: Relative change of depth between two neighbouring pixels that counts as an edge.

    Returns:
        (H, W, 3) float32 unit normals towards the camera; NaN where fewer than a tenth of the window has depth.

    References:
        The plane's image under a pinhole camera, 1/z = A x' + B y' + C with (A, B, C) parallel to the normal.
    """
    z = points[..., 2]
    q = 1.0 / z
    gradients = []
    for axis in (1, 0):
        step = np.diff(q, axis=axis)
        near = np.minimum(q[:, 1:], q[:, :-1]) if axis == 1 else np.minimum(q[1:], q[:-1])
        usable = np.abs(step) < jump * near
        pad = [(0, 0), (0, 0)]
        pad[axis] = (0, 1)
        weight = np.pad(usable.astype(np.float32), pad)
        value = np.pad(np.where(usable, step, np.float32(0)), pad)
        n = 2 * radius_px + 1
        weight = ndimage.uniform_filter(weight, n, mode="constant")
        value = ndimage.uniform_filter(value, n, mode="constant")
        gradients.append(np.where(weight > 0.1, value / np.maximum(weight, 1e-6), np.float32(np.nan)))
    a, b = gradients[0] * np.float32(camera.fx), gradients[1] * np.float32(camera.fy)
    c = q - (a * points[..., 0] + b * points[..., 1]) * q
    scale = -1 / np.sqrt(a * a + b * b + c * c)
    return np.stack([a * scale, b * scale, c * scale], axis=-1)
