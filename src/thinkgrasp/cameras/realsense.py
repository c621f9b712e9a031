"""Intel RealSense D455 and L515, live: depth aligned to colour, rectified, with the device's own intrinsics.

A frame is returned only when it is new: newer than the call, numbered after the one before, and not the same picture.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.cameras.distortion import Lens, Rectifier
from thinkgrasp.errors import ConfigError, InputError, MissingDependency
from thinkgrasp.types import CameraIntrinsics, Frame

Size = tuple[int, int]


@dataclass(frozen=True)
class Model:
    """How one model is used on a table at arm's length."""

    depth_wh: Size
    presets: str
    """Which of the SDK's lists of presets it has."""
    preset: str
    options: tuple[tuple[str, float], ...]


MODELS = {
    "D455": Model((848, 480), "rs400_visual_preset", "high_accuracy", (("emitter_enabled", 1.0),)),
    "L515": Model((640, 480), "l500_visual_preset", "short_range", ()),
}
"""Depth stream and preset by model: few wrong depths for the stereo camera, and for the lidar the preset whose laser
and gain do not saturate on things nearer than a metre. Other D400 models are used as the D455 is."""

COLOR_WH = (640, 480)
WARM_UP_FRAMES = 20
"""Thrown away at the start, while exposure and white balance settle."""
STALE_S = 0.5
"""A frame that was taken longer ago is not used."""
APART_MS = 60.0
"""Colour and depth of one frame are taken within this time."""
FRAMES_TO_TRY = 10
L515_HINT = "an L515 is seen by pyrealsense2 before 2.55 only: pip install 'pyrealsense2<2.55'"


class RealSenseCamera:
    """A RealSense on USB.

    Args:
        serial: Serial number, as digits or a number; None = the only one connected.
        color_size: Width and height of the frames.
        depth_size: Of the depth stream before it is aligned; None = the model's best.
        fps: Frames a second.
        preset: Visual preset by the SDK's name; None = the model's.
        depth_frames: Depth is the median over so many frames; more than one is for scenes that stand still.
        timeout_s: To wait for one frame.
        clock: Tells the time since the epoch [s].

    Raises:
        MissingDependency: pyrealsense2 is not installed.
        ConfigError: It cannot be loaded, there is no such camera or more than one, or it has no such stream or preset.
        InputError: Its lens cannot be rectified.
    """

    def __init__(
        self,
        *,
        serial: str | int | None = None,
        color_size: Size = COLOR_WH,
        depth_size: Size | None = None,
        fps: int = 30,
        preset: str | None = None,
        depth_frames: int = 1,
        timeout_s: float = 2.0,
        clock: Callable[[], float] = time.time,
    ) -> None:
        for name, number, most in (("depth_frames", depth_frames, 30), ("fps", fps, 300)):
            if type(number) is not int or not 1 <= number <= most:
                raise ConfigError(f"realsense: {name} must be a whole number in 1..{most}, got {number!r}")
        if not 0 < timeout_s <= 60:
            raise ConfigError(f"realsense: timeout_s must lie in (0, 60], got {timeout_s}")
        self._rs = rs = _sdk()
        self._clock, self._timeout_ms, self._depth_frames = clock, round(timeout_s * 1e3), depth_frames
        self.name, self.serial = self._find(serial)
        model = next((m for key, m in MODELS.items() if key in self.name), MODELS["D455"])
        config = rs.config()
        config.enable_device(self.serial)
        depth_wh, color_wh = _size(depth_size or model.depth_wh), _size(color_size)
        config.enable_stream(rs.stream.depth, *depth_wh, rs.format.z16, fps)
        config.enable_stream(rs.stream.color, *color_wh, rs.format.rgb8, fps)
        self._pipeline: Any = rs.pipeline()
        try:
            profile = self._pipeline.start(config)
        except RuntimeError as error:
            raise ConfigError(
                f"{self.name} cannot stream depth {depth_wh[0]}x{depth_wh[1]} and colour "
                f"{color_wh[0]}x{color_wh[1]} at "
                f"{fps} frames/s: {error}; is it on a USB 3 port, and free?"
            ) from error
        try:
            sensor = profile.get_device().first_depth_sensor()
            self._configure(sensor, model, preset)
            self.depth_scale = float(sensor.get_depth_scale())  # a preset may change it
            if not (math.isfinite(self.depth_scale) and self.depth_scale > 0):
                raise ConfigError(f"{self.name} says that its depth is in units of {self.depth_scale} m")
            self.intrinsics, self.lens = _intrinsics(
                profile.get_stream(rs.stream.color).as_video_stream_profile().get_intrinsics()
            )
            self._rectifier = Rectifier(self.intrinsics, self.lens)
        except RuntimeError as error:
            self._pipeline.stop()
            raise ConfigError(f"{self.name} cannot be set up: {error}") from error
        except BaseException:
            self._pipeline.stop()
            raise
        self._align: Any = rs.align(rs.stream.color)
        self._last: tuple[int, float] = (-1, -np.inf)
        self._last_depth: NDArray[np.uint16] | None = None
        self._cold = True

    def close(self) -> None:
        """Stop streaming."""
        with contextlib.suppress(RuntimeError):
            self._pipeline.stop()

    def read(self) -> Frame:
        """Return a frame that was taken after this call began.

        Raises:
            InputError: No frame comes, or only old ones, the same again, or ones whose colour and depth do not belong
                together.
        """
        if self._cold:
            for _ in range(WARM_UP_FRAMES):
                self._wait()
            self._cold = False
        self._drain()
        self._wait()  # its exposure may have begun before this call
        color, depths = self._next()
        for _ in range(self._depth_frames - 1):
            depths = np.concatenate([depths, self._next()[1]])
        depth = _median(depths).astype(np.float32) * np.float32(self.depth_scale)
        return Frame(self._rectifier.color(color), self._rectifier.depth(depth), self.intrinsics)

    def _next(self) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
        """Return colour (H, W, 3) and raw aligned depth (1, H, W) of the next good frame."""
        problem = ""
        for _ in range(FRAMES_TO_TRY):
            frames = self._wait()
            color, depth = frames.get_color_frame(), frames.get_depth_frame()
            if not color or not depth:
                problem = "one of colour and depth is missing"
                continue
            number, stamp_ms = int(depth.get_frame_number()), float(depth.get_timestamp())
            problem = self._problem(number, stamp_ms, float(color.get_timestamp()), depth)
            if problem:
                continue
            raw = np.asanyarray(depth.get_data())
            if self._last_depth is not None and np.array_equal(raw, self._last_depth):
                problem = f"frame {number} is the same picture as the one before: the camera is frozen"
                continue
            self._last, self._last_depth = (number, stamp_ms), raw.copy()
            aligned = self._align.process(frames)
            color, depth = aligned.get_color_frame(), aligned.get_depth_frame()
            if not color or not depth:
                problem = "depth cannot be aligned to colour"
                continue
            return np.array(np.asanyarray(color.get_data())), np.array(np.asanyarray(depth.get_data()))[None]
        raise InputError(
            f"{self.name} gives no new frame ({FRAMES_TO_TRY} looked at): {problem}; nothing was decided on it"
        )

    def _problem(self, number: int, stamp_ms: float, color_ms: float, depth: Any) -> str:
        """Say what is wrong with a frame; empty where nothing is."""
        last_number, last_ms = self._last
        if not (number > last_number and stamp_ms > last_ms):
            return f"frame {number} is not newer than frame {last_number} that was used before: the camera is frozen"
        if not abs(stamp_ms - color_ms) <= APART_MS:
            return f"colour and depth of frame {number} are {abs(stamp_ms - color_ms):.0f} ms apart"
        if depth.get_frame_timestamp_domain() != self._rs.timestamp_domain.hardware_clock:
            age_s = self._clock() - stamp_ms / 1e3
            if not age_s <= STALE_S:
                return f"frame {number} was taken {age_s:.1f} s ago"
        return ""

    def _wait(self) -> Any:
        try:
            came, frames = self._pipeline.try_wait_for_frames(self._timeout_ms)
        except RuntimeError as error:
            raise InputError(f"{self.name} cannot be read: {error}") from error
        if not came:
            raise InputError(
                f"no frame came from {self.name} within {self._timeout_ms / 1e3:g} s; is it still plugged in?"
            )
        return frames

    def _drain(self) -> None:
        """Throw away the frames that were taken before now."""
        for _ in range(64):
            try:
                if not self._pipeline.poll_for_frames():
                    return
            except RuntimeError as error:
                raise InputError(f"{self.name} cannot be read: {error}") from error

    def _find(self, serial: str | int | None) -> tuple[str, str]:
        """Return name and serial number of the camera."""
        info = self._rs.camera_info
        try:
            devices = self._rs.context().query_devices()
            found = [(d.get_info(info.name), d.get_info(info.serial_number)) for d in devices]
        except RuntimeError as error:
            raise ConfigError(f"the RealSense cameras cannot be listed: {error}; unplug and plug in again") from error
        if not found:
            raise ConfigError(f"no RealSense camera is connected; {L515_HINT}")
        listed = ", ".join(f"{name} ({number})" for name, number in found)
        if serial is None:
            if len(found) > 1:
                raise ConfigError(
                    f"more than one RealSense camera is connected: {listed}; say which by its serial number"
                )
            return found[0]
        for name, number in found:
            if number == str(serial):
                return name, number
        raise ConfigError(f"no RealSense camera {serial!r} is connected; there is {listed}; {L515_HINT}")

    def _configure(self, sensor: Any, model: Model, preset: str | None) -> None:
        option = self._rs.option
        presets = getattr(self._rs, model.presets, None)
        wanted = preset or model.preset
        if presets is None or not hasattr(presets, wanted):
            known = (
                []
                if presets is None
                else [n for n in dir(presets) if not n.startswith("_") and n not in ("name", "value")]
            )
            raise ConfigError(
                f"{self.name} has no preset {wanted!r}; allowed are {', '.join(known) or 'none in this SDK'}"
            )
        settings = [("visual_preset", float(int(getattr(presets, wanted)))), *model.options]
        for name, value in settings:
            if sensor.supports(getattr(option, name)):
                sensor.set_option(getattr(option, name), value)
            elif name == "visual_preset" and preset is not None:
                raise ConfigError(f"{self.name} has no presets; leave the setting preset out")


def _sdk() -> Any:
    try:
        import pyrealsense2  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError as error:
        raise MissingDependency("pyrealsense2", "realsense", "the RealSense camera") from error
    except ImportError as error:
        raise ConfigError(
            f"pyrealsense2 is installed but cannot be loaded: {error}; on Debian and Ubuntu: "
            "sudo apt-get install libusb-1.0-0"
        ) from error
    return pyrealsense2


def _size(size: Size) -> Size:
    given: Sequence[object] = size if isinstance(size, list | tuple) else ()
    if len(given) != 2 or not all(type(s) is int and s > 0 for s in given):
        raise ConfigError(f"realsense: a size must be two positive whole numbers, as [640, 480], got {size!r}")
    return size[0], size[1]


def _intrinsics(seen: Any) -> tuple[CameraIntrinsics, Lens]:
    camera = CameraIntrinsics(
        int(seen.width), int(seen.height), float(seen.fx), float(seen.fy), float(seen.ppx), float(seen.ppy)
    )
    name = str(getattr(seen.model, "name", seen.model)).rpartition(".")[2]
    return camera, Lens(name, tuple(float(c) for c in seen.coeffs))


def _median(raw: NDArray[np.uint16]) -> NDArray[np.floating]:
    """Median over frames (N, H, W) of the pixels that have a return in at least half of them; 0 elsewhere."""
    if len(raw) == 1:
        return raw[0].astype(np.float32)
    seen = raw > 0
    filled = np.where(seen, raw, np.nan)
    filled[:, seen.sum(axis=0) * 2 < len(raw)] = 0.0
    return np.nanmedian(filled, axis=0)
