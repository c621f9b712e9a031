"""The RealSense driver against the SDK's interface: what it sets, what it returns, and which frames it refuses."""

from __future__ import annotations

import sys
from types import ModuleType

import numpy as np
import pytest
from fakes.realsense_module import L500, RS400, Distortion, Domain, FakeRealSense
from fakes.stages import table_frame

from thinkgrasp import registry, testing
from thinkgrasp.cameras.realsense import WARM_UP_FRAMES, RealSenseCamera
from thinkgrasp.errors import ConfigError, InputError, MissingDependency
from thinkgrasp.types import Frame


class Noisy:
    """The table, with depth that is never twice the same."""

    def __init__(self) -> None:
        self.rng = np.random.default_rng(0)

    def __call__(self) -> Frame:
        frame = table_frame()
        depth = frame.depth + self.rng.normal(0, 0.003, frame.depth.shape).astype(np.float32)
        return Frame(frame.color, np.maximum(depth, 0).astype(np.float32), frame.camera)


@pytest.fixture
def usb(monkeypatch) -> FakeRealSense:
    camera = FakeRealSense(Noisy())
    monkeypatch.setitem(sys.modules, "pyrealsense2", camera.module())
    return camera


def test_frames_have_the_devices_intrinsics_and_metres(usb):
    usb.scale = 0.00025
    camera = RealSenseCamera(color_size=(64, 48))
    frame = camera.read()
    truth = table_frame()
    assert frame.camera == truth.camera
    assert frame.T_world_camera is None
    np.testing.assert_allclose(frame.depth, truth.depth, atol=0.02)
    np.testing.assert_array_equal(frame.color, truth.color)
    assert usb.number == WARM_UP_FRAMES + 2, "exposure settles first, and the frame that was under way is left out"
    camera.close()
    assert usb.stopped


def test_keeps_the_contract_of_a_camera(usb):
    testing.check_camera(registry.load("camera", "realsense"))


@pytest.mark.parametrize(
    ("name", "depth", "preset"),
    [
        ("Intel RealSense D455", (848, 480), RS400.high_accuracy),
        ("Intel RealSense L515", (640, 480), L500.short_range),
        ("Intel RealSense D435I", (848, 480), RS400.high_accuracy),
    ],
)
def test_each_model_has_its_settings(usb, name, depth, preset):
    usb.devices = [(name, "7")]
    RealSenseCamera()
    assert ("depth", *depth, "z16", 30) in usb.streams
    assert ("color", 640, 480, "rgb8", 30) in usb.streams
    assert ("device", "7") in usb.streams
    assert usb.options["visual_preset"] == float(preset)


def test_settings_can_be_chosen(usb):
    RealSenseCamera(serial="123", color_size=(1280, 720), depth_size=(1280, 720), fps=15, preset="high_density")
    assert ("color", 1280, 720, "rgb8", 15) in usb.streams
    assert ("depth", 1280, 720, "z16", 15) in usb.streams
    assert usb.options["visual_preset"] == float(RS400.high_density)


def test_depth_over_several_frames_is_steadier(usb):
    one = RealSenseCamera().read().depth
    many = RealSenseCamera(depth_frames=9).read().depth
    truth = table_frame().depth
    assert np.abs(many - truth).mean() < 0.6 * np.abs(one - truth).mean()


def test_a_bent_lens_is_rectified(usb):
    usb.model, usb.coeffs = Distortion.inverse_brown_conrady, (-0.2, 0.1, 0.0, 0.0, 0.0)
    bent = RealSenseCamera().read()
    usb.model, usb.coeffs = Distortion.none, (0.0,) * 5
    assert not np.array_equal(bent.color, RealSenseCamera().read().color)


def test_frames_that_waited_are_thrown_away(usb):
    camera = RealSenseCamera()
    camera.read()
    usb.queued, before = 5, usb.number
    camera.read()
    assert usb.number == before + 5 + 2


# -- frames that must not be used ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ({"stuck": True}, "is not newer than frame .* the camera is frozen"),
        ({"same": True}, "is the same picture as the one before: the camera is frozen"),
        ({"silent": True}, r"no frame came .* within 2 s; is it still plugged in"),
        ({"gone": True}, "cannot be read: Device disconnected"),
        ({"apart_ms": 120.0}, "colour and depth .* are 120 ms apart"),
    ],
    ids=["frozen", "same picture", "silent", "unplugged", "apart"],
)
def test_a_bad_frame_is_never_decided_on(usb, fault, message):
    camera = RealSenseCamera()
    camera.read()
    for name, value in fault.items():
        setattr(usb, name, value)
    with pytest.raises(InputError, match=message):
        camera.read()


def test_a_frame_that_was_taken_long_ago_is_never_decided_on(usb):
    usb.late_s = 3.0
    with pytest.raises(InputError, match=r"was taken 3\.\d s ago; nothing was decided on it"):
        RealSenseCamera().read()


def test_a_camera_that_comes_back_is_used_again(usb):
    camera = RealSenseCamera()
    camera.read()
    usb.late_s = 3.0
    with pytest.raises(InputError):
        camera.read()
    usb.late_s = 0.0
    assert camera.read().depth.any()


def test_clocks_of_the_device_are_not_compared_with_ours(usb):
    usb.domain, usb.late_s = Domain.hardware_clock, 1e6
    RealSenseCamera().read()


# -- cameras that cannot be used -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("devices", "settings", "message"),
    [
        ([], {}, r"no RealSense camera is connected; an L515 is seen by pyrealsense2 before 2\.55 only"),
        ([("D455", "1"), ("L515", "2")], {}, r"more than one .* D455 \(1\), L515 \(2\); say which"),
        ([("D455", "1")], {"serial": "9"}, r"no RealSense camera '9' is connected; there is D455 \(1\)"),
        ([("D455", "1")], {"preset": "best"}, "no preset 'best'; allowed are .*high_accuracy"),
        ([("D455", "1")], {"timeout_s": float("nan")}, r"timeout_s must lie in \(0, 60\]"),
        ([("D455", "1")], {"depth_frames": 0}, r"depth_frames must be a whole number in 1\.\.30"),
        ([("D455", "1")], {"depth_frames": "many"}, r"depth_frames must be a whole number in 1\.\.30, got 'many'"),
        ([("D455", "1")], {"fps": 29.97}, r"fps must be a whole number in 1\.\.300"),
        ([("D455", "1")], {"color_size": "640x480"}, r"two positive whole numbers, as \[640, 480\], got '640x480'"),
        ([("D455", "1")], {"depth_size": [640]}, "two positive whole numbers"),
        ([("D455", "1")], {"color_size": (0, 480)}, "two positive whole numbers"),
    ],
)
def test_cameras_that_cannot_be_used(usb, devices, settings, message):
    usb.devices = devices
    with pytest.raises(ConfigError, match=message):
        RealSenseCamera(**settings)


def test_streams_that_it_does_not_have(usb):
    usb.refuses = "Couldn't resolve requests"
    with pytest.raises(
        ConfigError, match=r"cannot stream depth 848x480 .* Couldn't resolve requests; is it on a USB 3"
    ):
        RealSenseCamera()


@pytest.mark.parametrize("scale", [0.0, -0.001, float("nan"), float("inf")])
def test_depth_without_a_unit_is_none(usb, scale):
    usb.scale = scale
    with pytest.raises(ConfigError, match="depth is in units of"):
        RealSenseCamera()
    assert usb.stopped


def test_settings_that_the_device_does_not_take(usb):
    usb.option_error = "hwmon command 0x.. failed"
    with pytest.raises(ConfigError, match="D455 cannot be set up: hwmon"):
        RealSenseCamera()
    assert usb.stopped
    usb.option_error, usb.lacks = "", ("visual_preset", "emitter_enabled")
    RealSenseCamera()
    with pytest.raises(ConfigError, match="has no presets"):
        RealSenseCamera(preset="high_density")


def test_a_serial_number_may_be_given_as_a_number(usb):
    """As --camera-set serial=123 gives it."""
    assert RealSenseCamera(serial=123).serial == "123"


def test_a_time_stamp_that_is_none_is_not_new(usb):
    camera = RealSenseCamera()
    usb.apart_ms = float("nan")
    with pytest.raises(InputError, match="nan ms apart"):
        camera.read()


def test_a_lens_that_cannot_be_rectified(usb):
    usb.model, usb.coeffs = Distortion.ftheta, (0.1,) * 5
    with pytest.raises(InputError, match="'ftheta' is not supported"):
        RealSenseCamera()
    assert usb.stopped, "the device is free again"


def test_the_sdk_is_not_installed(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(MissingDependency, match=r"pip install 'thinkgrasp\[realsense\]'"):
        RealSenseCamera()


def test_the_sdk_lacks_a_library(tmp_path, monkeypatch):
    (tmp_path / "pyrealsense2.py").write_text("raise ImportError('libusb-1.0.so.0: cannot open shared object file')")
    monkeypatch.delitem(sys.modules, "pyrealsense2", raising=False)
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(ConfigError, match=r"cannot be loaded: libusb.* apt-get install libusb-1\.0-0"):
        RealSenseCamera()


def test_the_sdk_has_what_the_fake_has():
    """The names that the driver and the fake use exist in pyrealsense2, where it can be loaded."""
    rs = pytest.importorskip("pyrealsense2", reason="pyrealsense2 cannot be loaded here", exc_type=ImportError)
    fake: ModuleType = FakeRealSense(Noisy()).module()
    names = [n for n in vars(fake) if not n.startswith("__")]
    assert [n for n in names if not hasattr(rs, n)] == []
    for group, fakes in (("rs400_visual_preset", RS400), ("timestamp_domain", Domain), ("distortion", Distortion)):
        assert [m.name for m in fakes if not hasattr(getattr(rs, group), m.name)] == []
    assert int(rs.rs400_visual_preset.high_accuracy) == int(RS400.high_accuracy)
    for owner, methods in {
        "pipeline": ("start", "stop", "try_wait_for_frames", "poll_for_frames"),
        "config": ("enable_device", "enable_stream"),
        "depth_sensor": ("get_depth_scale", "supports", "set_option"),
        "composite_frame": ("get_color_frame", "get_depth_frame"),
        "depth_frame": ("get_data", "get_frame_number", "get_timestamp", "get_frame_timestamp_domain"),
        "intrinsics": ("width", "height", "fx", "fy", "ppx", "ppy", "model", "coeffs"),
    }.items():
        assert [m for m in methods if not hasattr(getattr(rs, owner), m)] == []
