"""Image, CameraInfo and transform messages as frames: encodings, byte order, padding, intrinsics, poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import InputError
from thinkgrasp.geometry import make_transform, rotation_from_quat_wxyz
from thinkgrasp.types import CameraIntrinsics
from thinkgrasp_ros.interface import Message, Transform

COLOR_CHANNELS = {"rgb8": (0, 1, 2), "bgr8": (2, 1, 0), "rgba8": (0, 1, 2), "bgra8": (2, 1, 0), "mono8": (0, 0, 0)}
"""Encodings of colour, and where red, green and blue are in a pixel."""
_WIDTH_OF = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1}
DEPTH_UNITS = {"16UC1": ("u2", 0.001), "mono16": ("u2", 0.001), "32FC1": ("f4", 1.0)}
"""Encodings of depth (REP 118): type of a pixel, and metres per unit."""


def stamp_ns(message: Message) -> int:
    """Return the time in a message's header [ns].

    Raises:
        InputError: It is zero: the driver does not stamp its images.
    """
    stamp = message.header.stamp
    time = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
    if time == 0:
        raise InputError(f"a message in frame {message.header.frame_id!r} has no time stamp; frames need one for tf2")
    return time


def color_image(message: Message) -> NDArray[np.uint8]:
    """Return a colour Image message as (H, W, 3) uint8 RGB.

    Raises:
        InputError: The encoding is not taken, or the data are not what the header promises.
    """
    channels = COLOR_CHANNELS.get(message.encoding)
    if channels is None:
        raise InputError(
            f"colour images are {message.encoding!r}; taken are {', '.join(COLOR_CHANNELS)}: convert them in the "
            "driver or with image_proc"
        )
    pixels = _pixels(message, "u1", _WIDTH_OF[message.encoding], "colour")
    return np.ascontiguousarray(pixels[..., channels], np.uint8)


def depth_image(message: Message) -> NDArray[np.float32]:
    """Return a depth Image message as (H, W) float32 metres, 0 where there is no return.

    Raises:
        InputError: The encoding is not taken, or the data are not what the header promises.
    """
    unit = DEPTH_UNITS.get(message.encoding)
    if unit is None:
        raise InputError(f"depth images are {message.encoding!r}; taken are {', '.join(DEPTH_UNITS)} (REP 118)")
    kind, scale = unit
    raw = _pixels(message, kind, 1, "depth")[..., 0]
    if kind == "u2":
        raw = np.where(raw == 65535, np.zeros_like(raw), raw)
    metres = raw.astype(np.float64) * scale
    return np.where(np.isfinite(metres) & (metres > 0), metres, 0).astype(np.float32)


def intrinsics(message: Message, *, rectified: bool = False) -> CameraIntrinsics:
    """Return the pinhole camera of a CameraInfo message.

    Args:
        message: Of the colour image that the depth is aligned to.
        rectified: The images are rectified (image_rect): P is their camera, D that of the raw ones.

    Raises:
        InputError: The camera is not calibrated, has lens distortion, or its image is binned, cut out, or turned.
    """
    where = f"camera_info of frame {message.header.frame_id!r}"
    roi = message.roi
    whole = (roi.width, roi.height) in ((0, 0), (message.width, message.height))
    if message.binning_x > 1 or message.binning_y > 1 or roi.x_offset or roi.y_offset or not whole:
        raise InputError(f"{where} is of a binned or cut-out image, which is not taken: publish the full image")
    K = np.array(message.k, np.float64).reshape(3, 3)
    D = np.array(message.d, np.float64)
    if rectified:
        P = np.array(message.p, np.float64).reshape(3, 4)
        R = np.array(message.r, np.float64).reshape(3, 3)
        if not np.abs(P[:, 3]).max() <= 1e-9:
            raise InputError(f"{where} is of the second camera of a stereo pair (P has an offset); take the first")
        if R.any() and not np.allclose(R, np.eye(3), atol=1e-6):
            raise InputError(f"{where} turns the image to rectify it (R), so that its frame is not the image's")
        K = P[:, :3]
    elif D.any():
        raise InputError(
            f"{where} has lens distortion, {message.distortion_model} {np.round(D, 4).tolist()}; subscribe to the "
            "rectified images (image_rect) and set the parameter rectified"
        )
    if not (K[0, 0] > 0 and K[1, 1] > 0 and np.isfinite(K).all()):
        raise InputError(f"{where} has focal lengths {K[0, 0]:g}, {K[1, 1]:g}: the camera is not calibrated")
    if abs(K[0, 1]) > 1e-6 * K[0, 0]:
        raise InputError(f"{where} has skew {K[0, 1]:g}, which is not taken")
    return CameraIntrinsics(
        int(message.width), int(message.height), float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
    )


def transform_matrix(message: Message) -> Transform:
    """Return a geometry_msgs/Transform as (4, 4).

    Raises:
        InputError: It is not finite, or its quaternion has no length.
    """
    t, q = message.translation, message.rotation
    quat = np.array([q.w, q.x, q.y, q.z], np.float64)
    shift = np.array([t.x, t.y, t.z], np.float64)
    if not (np.isfinite(quat).all() and np.isfinite(shift).all() and abs(np.linalg.norm(quat) - 1) < 1e-2):
        raise InputError(
            f"tf2 returned no rigid transform: translation {shift.tolist()}, quaternion wxyz {quat.tolist()}"
        )
    return make_transform(rotation_from_quat_wxyz(quat), shift)


def _pixels(message: Message, kind: str, channels: int, what: str) -> NDArray[np.generic]:
    """(H, W, channels) of an Image message, without the padding of its rows, in this machine's byte order."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    size = np.dtype(kind).itemsize
    row = width * channels * size
    data = np.frombuffer(message.data, np.uint8)
    if height == 0 or width == 0 or step < row or len(data) < step * height:
        raise InputError(
            f"the {what} image says {width}x{height} {message.encoding} with {step} bytes a row, and holds {len(data)} "
            f"bytes; it would need {row} a row and {max(step, row) * height} in all"
        )
    packed = np.ascontiguousarray(data[: step * height].reshape(height, step)[:, :row])
    order = ">" if message.is_bigendian else "<"
    pixels = packed.view(np.dtype(order + kind)).reshape(height, width, channels)
    return pixels.astype(pixels.dtype.newbyteorder("="), copy=False)
