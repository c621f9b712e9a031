"""Frames out of topics: newer than the question, of one moment, in one frame, with the pose of that moment."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from fakes.ros import FakeClock, FakeTransforms, camera_info, image, parameters
from fakes.stages import table_frame
from fakes.table_loop import POSE
from scipy.spatial.transform import Rotation
from thinkgrasp_ros.cameras import TopicCamera

from thinkgrasp.errors import InputError
from thinkgrasp.geometry import make_transform

FRAME = table_frame()
MS = 1_000_000


def messages(ns: int, *, depth_ns: int | None = None, info_ns: int | None = None, depth_frame: str = "camera_optical"):
    mm = np.rint(FRAME.depth * 1000).astype(np.uint16)
    return (
        image(FRAME.color, "rgb8", ns),
        image(mm, "16UC1", ns if depth_ns is None else depth_ns, frame=depth_frame),
        camera_info(FRAME.camera, ns if info_ns is None else info_ns),
    )


def camera(clock: FakeClock, transforms: FakeTransforms | None = None, **changes) -> TopicCamera:
    told = parameters(**({"image_timeout_s": 0.15} | changes))
    return TopicCamera(told.camera_parameters[0], told, transforms or FakeTransforms({"camera_optical": POSE}), clock)


def test_a_frame_is_what_the_messages_say():
    clock, transforms = FakeClock(), FakeTransforms({"camera_optical": POSE})
    cam = camera(clock, transforms)
    cam.feed(*messages(clock.ns + 20 * MS, depth_ns=clock.ns))
    frame = cam.read()
    assert np.array_equal(frame.color, FRAME.color)
    assert np.allclose(frame.depth, FRAME.depth, atol=6e-4)
    assert frame.camera == FRAME.camera
    assert frame.T_world_camera is POSE
    assert transforms.asked == [("base_link", "camera_optical", clock.ns)], (
        "the pose at the images' time, not the latest"
    )
    assert frame.workspace is None


def test_images_from_before_the_question_are_not_taken():
    clock = FakeClock()
    cam = camera(clock)
    cam.feed(*messages(clock.ns - 30 * MS))
    later = threading.Timer(0.05, lambda: cam.feed(*messages(clock.ns + 10 * MS)))
    later.start()
    cam.read()
    later.join()


def test_depth_from_before_the_question_is_not_taken_with_a_colour_image_from_after_it():
    clock = FakeClock()
    cam = camera(clock)
    cam.feed(*messages(clock.ns + 10 * MS, depth_ns=clock.ns - 20 * MS))
    with pytest.raises(InputError, match="no new images"):
        cam.read()


def test_a_frozen_camera_and_a_silent_one_are_named():
    clock = FakeClock()
    silent = camera(clock)
    with pytest.raises(InputError, match=r"'camera': nothing came together on /camera/color/image_raw, .* in 0.15 s"):
        silent.read()
    frozen = camera(clock)
    frozen.feed(*messages(clock.ns - 3200 * MS))
    with pytest.raises(InputError, match=r"was 3\.2 s old when asked for: it is frozen, or its clock"):
        frozen.read()


def test_a_clock_that_is_ahead_is_named():
    clock = FakeClock()
    cam = camera(clock)
    cam.feed(*messages(clock.ns + 5000 * MS))
    with pytest.raises(InputError, match=r"5\.0 s ahead of the node's clock"):
        cam.read()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"depth_ns": 1_000_000_000_000 + 80 * MS}, "80 ms apart .allowed 50 ms, parameter sync_slop_s"),
        ({"info_ns": 1_000_000_000_000 - 51 * MS}, "51 ms apart"),
        ({"depth_ns": 0}, "no time stamp"),
        ({"depth_frame": "depth_optical"}, "different frames, camera_optical, depth_optical; depth must be aligned"),
    ],
)
def test_what_does_not_belong_together_is_refused(change, said):
    clock = FakeClock()
    cam = camera(clock)
    cam.feed(*messages(clock.ns, **change))
    with pytest.raises(InputError, match=said):
        cam.read()


def test_good_images_after_bad_ones_are_taken():
    clock = FakeClock()
    cam = camera(clock)
    cam.feed(*messages(clock.ns, depth_ns=clock.ns + 80 * MS))
    cam.feed(*messages(clock.ns + 10 * MS))
    assert cam.read().T_world_camera is POSE


def test_a_pose_that_tf_does_not_know_is_an_input_error():
    clock = FakeClock()
    cam = camera(clock, FakeTransforms({}))
    cam.feed(*messages(clock.ns))
    with pytest.raises(InputError, match="source_frame does not exist"):
        cam.read()
    cam = camera(clock, FakeTransforms({"camera_optical": POSE}, until_ns=clock.ns - 1))
    cam.feed(*messages(clock.ns))
    with pytest.raises(InputError, match="extrapolation into the future"):
        cam.read()


def test_a_frame_that_is_not_optical_is_named():
    """A simulator's camera_link: x forward, z up; here pitched down by 40 degrees."""
    pitched = make_transform(Rotation.from_euler("y", 40, degrees=True).as_matrix(), np.array([0, 0, 0.8]))
    optical = pitched @ make_transform(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))
    clock = FakeClock()
    for pose, good in ((pitched, False), (optical, True)):
        cam = camera(clock, FakeTransforms({"camera_optical": pose}))
        cam.feed(*messages(clock.ns))
        if good:
            assert cam.read().T_world_camera is pose
        else:
            with pytest.raises(InputError, match=r"z of its frame 'camera_optical' points upwards .*optical frame"):
                cam.read()


def test_the_workspace_is_a_box_in_the_world():
    clock = FakeClock()
    cam = camera(clock, workspace=(-1.0, -1.0, -0.75, 0.0, 1.0, 0.0))
    cam.feed(*messages(clock.ns))
    workspace = cam.read().workspace
    assert workspace is not None
    near = FRAME.depth < 0.75
    assert np.array_equal(workspace, near & (np.arange(64) < 32)), "the left block alone: nearer than the table, x < 0"
