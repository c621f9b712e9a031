"""The interface of pyrealsense2 as far as the driver uses it, over frames that a function makes."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cached_property
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from thinkgrasp.types import CameraIntrinsics, Frame


class RS400(IntEnum):
    custom, default, hand, high_accuracy, high_density = range(5)


class L500(IntEnum):
    custom, default, no_ambient_light, low_ambient_light, max_range, short_range = range(6)


class Domain(IntEnum):
    hardware_clock, system_time, global_time = range(3)


class Distortion(IntEnum):
    none, modified_brown_conrady, inverse_brown_conrady, ftheta, brown_conrady = range(5)


@dataclass
class FakeRealSense:
    """A camera on USB, and how it misbehaves.

    Attributes:
        source: Makes what it sees now.
        camera: Intrinsics of that; None = looked up in a first frame.
        devices: Names and serial numbers.
        stuck: Frame numbers and times do not go on.
        same: The picture does not change.
        late_s: Frames are so old.
        silent: No frame comes.
        gone: Reading raises.
        apart_ms: Between colour and depth.
        domain: Of the time stamps.
        model, coeffs: Of the lens.
        lacks: Names of the options that it does not have.
        option_error: What setting an option raises.
    """

    source: Callable[[], Frame]
    camera: CameraIntrinsics | None = None
    devices: list[tuple[str, str]] = field(default_factory=lambda: [("Intel RealSense D455", "123")])
    stuck: bool = False
    same: bool = False
    late_s: float = 0.0
    silent: bool = False
    gone: bool = False
    apart_ms: float = 0.0
    domain: Domain = Domain.global_time
    model: Distortion = Distortion.none
    coeffs: tuple[float, ...] = (0.0,) * 5
    scale: float = 0.001
    refuses: str = ""
    lacks: tuple[str, ...] = ()
    option_error: str = ""
    queued: int = 0
    options: dict[str, float] = field(default_factory=dict)
    streams: list[tuple[Any, ...]] = field(default_factory=list)
    number: int = 0
    rendered: int = 0
    stopped: bool = False
    kept: Frame | None = None

    def module(self) -> ModuleType:
        """The module to import instead of pyrealsense2."""
        rs = ModuleType("pyrealsense2")
        camera = self

        class Pipeline:
            def start(self, config: Any) -> Any:
                if camera.refuses:
                    raise RuntimeError(camera.refuses)
                return SimpleNamespace(
                    get_device=lambda: SimpleNamespace(first_depth_sensor=lambda: Sensor()),
                    get_stream=lambda stream: SimpleNamespace(
                        as_video_stream_profile=lambda: SimpleNamespace(get_intrinsics=camera.intrinsics)
                    ),
                )

            def stop(self) -> None:
                camera.stopped = True

            def try_wait_for_frames(self, timeout_ms: int) -> tuple[bool, Any]:
                if camera.gone:
                    raise RuntimeError("Device disconnected")
                return (False, None) if camera.silent else (True, FrameSet(camera))

            def poll_for_frames(self) -> Any:
                if camera.queued:
                    camera.queued -= 1
                    return FrameSet(camera)
                return None

        class Sensor:
            def get_depth_scale(self) -> float:
                return camera.scale

            def supports(self, option: str) -> bool:
                return option not in camera.lacks

            def set_option(self, option: str, value: float) -> None:
                if camera.option_error:
                    raise RuntimeError(camera.option_error)
                camera.options[option] = value

        class Config:
            def enable_device(self, serial: str) -> None:
                camera.streams.append(("device", serial))

            def enable_stream(self, *what: Any) -> None:
                camera.streams.append(what)

        members: dict[str, Any] = {
            "pipeline": Pipeline,
            "config": Config,
            "context": lambda: SimpleNamespace(
                query_devices=lambda: [
                    SimpleNamespace(get_info=dict(zip(("name", "serial"), d, strict=True)).__getitem__)
                    for d in camera.devices
                ]
            ),
            "camera_info": SimpleNamespace(name="name", serial_number="serial"),
            "stream": SimpleNamespace(depth="depth", color="color"),
            "format": SimpleNamespace(z16="z16", rgb8="rgb8"),
            "option": SimpleNamespace(visual_preset="visual_preset", emitter_enabled="emitter_enabled"),
            "rs400_visual_preset": RS400,
            "l500_visual_preset": L500,
            "timestamp_domain": Domain,
            "distortion": Distortion,
            "align": lambda stream: SimpleNamespace(process=lambda frames: frames),
        }
        for name, value in members.items():
            setattr(rs, name, value)
        return rs

    def intrinsics(self) -> Any:
        c = self.camera or self.look().camera
        return SimpleNamespace(
            width=c.width, height=c.height, fx=c.fx, fy=c.fy, ppx=c.cx, ppy=c.cy, model=self.model, coeffs=self.coeffs
        )

    def look(self) -> Frame:
        if self.same and self.kept is not None:
            return self.kept
        self.rendered += 1
        self.kept = self.source()
        return self.kept


class FrameSet:
    """One colour and one depth image, made when somebody looks at them."""

    def __init__(self, camera: FakeRealSense) -> None:
        if not camera.stuck or camera.number == 0:
            camera.number += 1
        self._camera, self.number = camera, camera.number
        self.stamp_ms = (time.time() - camera.late_s) * 1e3 if not camera.stuck else 1.0

    @cached_property
    def frame(self) -> Frame:
        return self._camera.look()

    def get_color_frame(self) -> Any:
        return Image(self, self.stamp_ms + self._camera.apart_ms, lambda: self.frame.color)

    def get_depth_frame(self) -> Any:
        scale = self._camera.scale
        return Image(self, self.stamp_ms, lambda: np.rint(self.frame.depth / scale).astype(np.uint16))


class Image:
    """One image of a set."""

    def __init__(self, frames: FrameSet, stamp_ms: float, data: Callable[[], np.ndarray]) -> None:
        self._frames, self._stamp_ms, self._data = frames, stamp_ms, data

    def get_data(self) -> np.ndarray:
        return self._data()

    def get_frame_number(self) -> int:
        return self._frames.number

    def get_timestamp(self) -> float:
        return self._stamp_ms

    def get_frame_timestamp_domain(self) -> Domain:
        return self._frames._camera.domain
