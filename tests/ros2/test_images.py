"""Messages of cameras as frames: every encoding, byte order and padding, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from fakes.ros import Strict, camera_info, image, stamped
from scipy.spatial.transform import Rotation
from thinkgrasp_ros.images import color_image, depth_image, intrinsics, stamp_ns, transform_matrix

from thinkgrasp.errors import InputError
from thinkgrasp.types import CameraIntrinsics

NS = 5_250_000_000
CAMERA = CameraIntrinsics(7, 5, 600.0, 601.0, 3.0, 2.0)
RNG = np.random.default_rng(0)
RGB = RNG.integers(0, 256, (5, 7, 3), dtype=np.uint8)


@pytest.mark.parametrize("pad", [0, 3])
@pytest.mark.parametrize(
    ("encoding", "array"),
    [
        ("rgb8", RGB),
        ("bgr8", RGB[..., ::-1]),
        ("rgba8", np.concatenate([RGB, RGB[..., :1]], axis=-1)),
        ("bgra8", np.concatenate([RGB[..., ::-1], RGB[..., :1]], axis=-1)),
    ],
)
def test_colour(encoding, array, pad):
    found = color_image(image(array, encoding, NS, pad=pad))
    assert found.dtype == np.uint8
    assert found.flags.c_contiguous
    assert np.array_equal(found, RGB)


def test_grey_is_repeated():
    assert np.array_equal(color_image(image(RGB[..., 0], "mono8", NS)), np.repeat(RGB[..., :1], 3, axis=2))


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("pad", [0, 6])
def test_depth_in_both_encodings(big, pad):
    mm = RNG.integers(200, 3000, (5, 7)).astype(np.uint16)
    mm[0, 0], mm[0, 1] = 0, 65535
    metres = np.where((mm == 0) | (mm == 65535), 0, mm / 1000).astype(np.float32)
    for encoding in ("16UC1", "mono16"):
        found = depth_image(image(mm, encoding, NS, pad=pad, big=big))
        assert found.dtype == np.float32
        assert np.allclose(found, metres, atol=1e-7)
    floats = metres.copy()
    floats[0, 0], floats[0, 1] = np.nan, np.inf
    assert np.array_equal(depth_image(image(floats, "32FC1", NS, pad=pad, big=big)), metres)


def test_data_may_be_an_array_of_bytes():
    """rclpy delivers array.array."""
    import array

    message = image(RGB, "rgb8", NS)
    object.__setattr__(message, "data", array.array("B", message.data))
    assert np.array_equal(color_image(message), RGB)


def test_what_images_are_refused():
    with pytest.raises(InputError, match="'yuv422'; taken are rgb8, bgr8"):
        color_image(image(RGB[..., :2], "yuv422", NS))
    with pytest.raises(InputError, match="'rgb8'; taken are 16UC1, mono16, 32FC1"):
        depth_image(image(RGB, "rgb8", NS))
    for change in ({"step": 20}, {"height": 6}, {"width": 0}, {"height": 0}, {"data": b""}):
        message = image(RGB, "rgb8", NS)
        for key, value in change.items():
            setattr(message, key, value)
        with pytest.raises(InputError, match="the colour image says"):
            color_image(message)


def test_stamps():
    assert stamp_ns(image(RGB, "rgb8", NS)) == NS
    with pytest.raises(InputError, match="no time stamp"):
        stamp_ns(image(RGB, "rgb8", 0))


def test_intrinsics_of_a_camera_without_distortion():
    assert intrinsics(camera_info(CAMERA, NS)) == CAMERA
    assert intrinsics(camera_info(CAMERA, NS, d=[0.0] * 5)) == CAMERA


def test_distortion_is_refused_unless_the_images_are_rectified():
    message = camera_info(CAMERA, NS, d=[0.1, -0.2, 0, 0, 0])
    with pytest.raises(InputError, match=r"lens distortion, plumb_bob \[0.1, -0.2.*image_rect.*parameter rectified"):
        intrinsics(message)
    p = list(message.p)
    p[0], p[5] = 590.0, 591.0
    message.p = p
    assert intrinsics(message, rectified=True) == CameraIntrinsics(7, 5, 590.0, 591.0, 3.0, 2.0)


@pytest.mark.parametrize(
    ("change", "rectified", "said"),
    [
        ({"binning_x": 2}, False, "binned or cut-out"),
        ({"k": [0.0] * 9}, False, "not calibrated"),
        ({"k": [600.0, 5.0, 3.0, 0.0, 600.0, 2.0, 0.0, 0.0, 1.0]}, False, "skew"),
        ({"k": [600.0, 0.0, 99.0, 0.0, 600.0, 2.0, 0.0, 0.0, 1.0]}, False, "principal point"),
        ({"p": [600.0, 0, 3.0, -30.0, 0, 600.0, 2.0, 0, 0, 0, 1.0, 0]}, True, "second camera of a stereo pair"),
        ({"p": [600.0, 0, 3.0, float("nan"), 0, 600.0, 2.0, 0, 0, 0, 1.0, 0]}, True, "second camera of a stereo pair"),
        ({"r": [0.0, -1.0, 0, 1.0, 0, 0, 0, 0, 1.0]}, True, "turns the image"),
        ({"p": [0.0] * 12}, True, "not calibrated"),
    ],
)
def test_what_cameras_are_refused(change, rectified, said):
    message = camera_info(CAMERA, NS)
    for key, value in change.items():
        setattr(message, key, [float(v) for v in value] if isinstance(value, list) else value)
    with pytest.raises(InputError, match=said):
        intrinsics(message, rectified=rectified)


def test_a_region_of_interest_is_refused():
    message = camera_info(CAMERA, NS)
    message.roi.width = 3
    with pytest.raises(InputError, match="cut-out"):
        intrinsics(message)


def test_a_region_that_is_the_whole_image_is_none():
    """sensor_msgs/CameraInfo: all zeros mean the same as the full width and height."""
    message = camera_info(CAMERA, NS)
    message.roi.width, message.roi.height = CAMERA.width, CAMERA.height
    assert intrinsics(message) == CAMERA
    message.roi.x_offset = 1
    with pytest.raises(InputError, match="cut-out"):
        intrinsics(message)


def test_transforms():
    R = Rotation.from_euler("xyz", [0.3, -0.5, 1.1])
    message = Strict("geometry_msgs/msg/Transform")
    message.rotation.x, message.rotation.y, message.rotation.z, message.rotation.w = map(float, R.as_quat())
    message.translation.x = 0.4
    T = transform_matrix(message)
    assert np.allclose(T[:3, :3], R.as_matrix())
    assert T[:, 3].tolist() == [0.4, 0, 0, 1]
    message.rotation.w = float("nan")
    with pytest.raises(InputError, match="no rigid transform"):
        transform_matrix(message)
    with pytest.raises(InputError, match="no rigid transform"):
        transform_matrix(Strict("geometry_msgs/msg/Transform"))


def test_fakes_refuse_what_rclpy_refuses():
    message = stamped(Strict("sensor_msgs/msg/Image"), NS)
    with pytest.raises(AttributeError, match="no field 'colour'"):
        message.colour = 1
    with pytest.raises(AssertionError, match="must be a int"):
        message.height = 1.0
    with pytest.raises(AssertionError, match="does not fit uint32"):
        message.height = -1
