"""A camera that is fed with synchronised messages, and waits for ones that are newer than the question."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass

import numpy as np

from thinkgrasp.errors import InputError
from thinkgrasp.geometry import apply, deproject
from thinkgrasp.types import Frame
from thinkgrasp_ros.images import color_image, depth_image, intrinsics, stamp_ns
from thinkgrasp_ros.interface import Clock, Message, Transform, Transforms
from thinkgrasp_ros.parameters import CameraParameters, Parameters

_MAX_AHEAD_NS = 1_000_000_000
_UPWARDS = 0.3
"""Sine of an angle above the horizon at which no camera looks that sees a table."""


@dataclass(frozen=True, eq=False)
class _Set:
    color: Message
    depth: Message
    info: Message
    stamp_ns: int
    """When the older of the two images was taken."""


class TopicCamera:
    """Frames of one camera's topics, with its pose from tf2 at the images' time.

    Args:
        camera: Its topics' names, for messages to people, and whether its images are rectified.
        parameters: World frame, workspace and times.
        transforms: Gives the camera's pose.
        clock: What the images are stamped with, and what "newer" is measured by.
    """

    def __init__(self, camera: CameraParameters, parameters: Parameters, transforms: Transforms, clock: Clock) -> None:
        self.camera = camera
        self._parameters = parameters
        self._transforms = transforms
        self._clock = clock
        self._news = threading.Condition()
        self._newest: _Set | None = None
        self._refused: InputError | None = None

    def feed(self, color: Message, depth: Message, info: Message) -> None:
        """Take messages of one moment, from whatever thread; what is wrong with them is said at the next `read`."""
        with self._news:
            try:
                self._newest, self._refused = self._checked(color, depth, info), None
            except InputError as error:
                self._refused = error
            self._news.notify_all()

    def read(self) -> Frame:
        """Wait for images taken after the call, and return them as a frame.

        Raises:
            InputError: None came in time, they cannot be used, or the camera's pose is not known or looks upwards.
        """
        found = self._wait(self._clock.now_ns())
        source = found.color.header.frame_id
        frame = Frame(
            color_image(found.color),
            depth_image(found.depth),
            intrinsics(found.info, rectified=self.camera.rectified),
            self._pose(source, found.stamp_ns),
        )
        if not len(self._parameters.workspace):
            return frame
        world = apply(frame.T_world_camera, deproject(frame.depth, frame.camera))  # type: ignore[arg-type]
        low, high = np.array(self._parameters.workspace, np.float32).reshape(2, 3)
        with np.errstate(invalid="ignore"):
            inside = np.asarray(((world > low) & (world < high)).all(axis=-1), np.bool_)
        return Frame(frame.color, frame.depth, frame.camera, frame.T_world_camera, inside)

    def _pose(self, source: str, ns: int) -> Transform:
        T = self._transforms.lookup(self._parameters.world_frame, source, ns)
        if T[2, 2] > _UPWARDS:
            raise InputError(
                f"camera {self.camera.name!r}: z of its frame {source!r} points upwards in "
                f"{self._parameters.world_frame!r}: images must be in an optical frame (REP 103: z forward, x right), "
                "and z of world_frame must be up"
            )
        return T

    def _checked(self, color: Message, depth: Message, info: Message) -> _Set:
        name, slop_ns = self.camera.name, self._parameters.sync_slop_s * 1e9
        times = [stamp_ns(m) for m in (color, depth, info)]
        if max(times) - min(times) > slop_ns:
            raise InputError(
                f"camera {name!r}: colour, depth and camera_info are {(max(times) - min(times)) / 1e6:.0f} ms apart "
                f"(allowed {slop_ns / 1e6:.0f} ms, parameter sync_slop_s)"
            )
        frames = {m.header.frame_id for m in (color, depth, info)}
        if len(frames) > 1:
            raise InputError(
                f"camera {name!r}: colour, depth and camera_info are in different frames, {', '.join(sorted(frames))}; "
                "depth must be aligned to colour (realsense2_camera: align_depth.enable)"
            )
        return _Set(color, depth, info, min(times[:2]))

    def _wait(self, since_ns: int) -> _Set:
        deadline = time.monotonic() + self._parameters.image_timeout_s
        with self._news:
            while self._newest is None or self._newest.stamp_ns < since_ns:
                left = deadline - time.monotonic()
                if left <= 0 or not self._news.wait(left):
                    raise self._refused or InputError(self._silence(since_ns))
            if self._newest.stamp_ns - self._clock.now_ns() > _MAX_AHEAD_NS:
                ahead = (self._newest.stamp_ns - self._clock.now_ns()) / 1e9
                raise InputError(
                    f"camera {self.camera.name!r}: its images are stamped {ahead:.1f} s ahead of the node's clock; "
                    "set the clocks alike (use_sim_time?)"
                )
            return self._newest

    def _silence(self, since_ns: int) -> str:
        topics = f"{self.camera.color_topic}, {self.camera.depth_topic} and {self.camera.info_topic}"
        waited = f"in {self._parameters.image_timeout_s:g} s"
        if self._newest is None:
            return f"camera {self.camera.name!r}: nothing came together on {topics} {waited}"
        age = (since_ns - self._newest.stamp_ns) / 1e9
        return (
            f"camera {self.camera.name!r}: no new images {waited}; the newest on {topics} was {age:.1f} s old when "
            "asked for: it is frozen, or its clock is not the node's"
        )
