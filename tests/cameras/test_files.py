"""Frames from files: every accepted encoding gives the right numbers, everything else one clear InputError."""

from __future__ import annotations

import io
import json
import os
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from thinkgrasp.cameras import files
from thinkgrasp.cameras.files import FileCamera, load_camera, load_frame, read_color
from thinkgrasp.cameras.saving import save_frame
from thinkgrasp.errors import InputError
from thinkgrasp.interfaces import Camera
from thinkgrasp.types import CameraIntrinsics, Frame

REAL_SCENES = Path(__file__).resolve().parents[3] / "shared" / "real_scenes"
needs_real_scenes = pytest.mark.skipif(
    not REAL_SCENES.is_dir(), reason="the real frames (../shared/real_scenes) are not here"
)


def png16(pixels: np.ndarray, color_type: int) -> bytes:
    """Encode (H, W, C) uint16 as PNG by hand: Pillow writes no 16-bit colour."""
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in pixels)

    def chunk(tag: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + tag + data + struct.pack(">I", zlib.crc32(tag + data))

    header = struct.pack(">IIBBBBB", pixels.shape[1], pixels.shape[0], 16, color_type, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


class TestColor:
    @pytest.mark.parametrize(("color_type", "channels"), [(2, 3), (6, 4)])
    def test_sixteen_bit_colour_keeps_the_upper_eight_bits(self, tmp_path, color_type, channels):
        pixels = np.random.default_rng(0).integers(0, 65536, (5, 7, channels), dtype=np.uint16)
        (tmp_path / "c.png").write_bytes(png16(pixels, color_type))
        assert np.array_equal(read_color(tmp_path / "c.png"), (pixels >> 8)[..., :3])

    def test_sixteen_bit_grey_is_repeated(self, tmp_path):
        pixels = np.arange(0, 65536, 1873, dtype=np.uint16)[:35].reshape(5, 7)
        Image.fromarray(pixels).save(tmp_path / "c.png")
        assert np.array_equal(read_color(tmp_path / "c.png"), np.repeat((pixels >> 8)[..., None], 3, axis=2))

    def test_sixteen_bit_grey_with_alpha(self, tmp_path):
        pixels = np.random.default_rng(0).integers(0, 65536, (5, 7, 2), dtype=np.uint16)
        (tmp_path / "c.png").write_bytes(png16(pixels, 4))
        assert np.array_equal(read_color(tmp_path / "c.png")[..., 0], pixels[..., 0] >> 8)

    def test_alpha_is_dropped_even_where_transparent(self, tmp_path):
        pixels = np.random.default_rng(0).integers(0, 256, (5, 7, 4), dtype=np.uint8)
        Image.fromarray(pixels).save(tmp_path / "c.png")
        assert np.array_equal(read_color(tmp_path / "c.png"), pixels[..., :3])

    @pytest.mark.parametrize("mode", ["L", "LA", "P", "1", "CMYK", "YCbCr"])
    def test_other_modes_become_rgb(self, tmp_path, mode):
        grey = Image.fromarray(np.full((5, 7), 255, np.uint8)).convert("RGB").convert(mode)
        grey.save(tmp_path / "c.tiff")
        assert np.array_equal(read_color(tmp_path / "c.tiff"), np.full((5, 7, 3), 255, np.uint8))

    def test_exif_orientation_is_applied(self, tmp_path):
        image = Image.fromarray(np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8))
        exif = Image.Exif()
        exif[0x0112] = 6
        image.save(tmp_path / "c.png", exif=exif)
        assert np.array_equal(read_color(tmp_path / "c.png"), np.rot90(np.array(image), -1))

    @pytest.mark.parametrize("shape", [(5, 7), (5, 7, 1), (5, 7, 3), (5, 7, 4)])
    def test_npy(self, tmp_path, shape):
        pixels = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
        np.save(tmp_path / "c.npy", pixels)
        got = read_color(tmp_path / "c.npy")
        assert got.shape == (5, 7, 3)
        assert np.array_equal(got[..., 0], pixels.reshape(5, 7, -1)[..., 0])

    @pytest.mark.parametrize(
        ("pixels", "message"),
        [
            (np.zeros((5, 7, 3), np.float32), "float32 pixels"),
            (np.zeros((5, 7, 2), np.uint8), "shape"),
            (np.full((5, 7), -1, np.int16), "values in -1..-1"),
            (np.zeros((0, 7, 3), np.uint8), "shape"),
        ],
    )
    def test_impossible_arrays(self, tmp_path, pixels, message):
        np.save(tmp_path / "c.npy", pixels)
        with pytest.raises(InputError, match=message):
            read_color(tmp_path / "c.npy")


def write_depth(path: Path, values: np.ndarray) -> Path:
    if path.suffix == ".npy":
        np.save(path, values)
    else:
        Image.fromarray(values).save(path)
    return path


class TestDepth:
    @pytest.mark.parametrize(
        ("name", "dtype", "unit"),
        [
            ("d.png", np.uint16, 1000),
            ("d.tiff", np.uint16, 1000),
            ("d.tiff", np.int32, 1000),
            ("d.npy", np.uint16, 1000),
            ("d.npy", np.int64, 1000),
            ("d.npy", ">u2", 1000),
            ("d.tiff", np.float32, 1),
            ("d.npy", np.float32, 1),
            ("d.npy", np.float64, 1),
            ("d.npy", np.float16, 1),
        ],
    )
    def test_integers_are_scaled_and_floats_are_metres(self, tmp_path, frame_files, frame, name, dtype, unit):
        path = write_depth(tmp_path / name, (np.round(frame.depth, 3) * unit + (unit > 1) * 0.5).astype(dtype))
        got = load_frame(frame_files.color, path, frame_files.camera).depth
        assert got.dtype == np.float32
        assert np.allclose(got, frame.depth, atol=5e-4)

    def test_one_channel_array_is_accepted(self, tmp_path, frame_files, frame):
        path = write_depth(tmp_path / "d.npy", frame.depth[..., None])
        assert np.array_equal(load_frame(frame_files.color, path, frame_files.camera).depth, frame.depth)

    def test_the_scale_comes_from_the_argument_then_the_camera_then_the_default(self, tmp_path, frame_files, frame):
        path = write_depth(tmp_path / "d.png", (frame.depth * 5000).astype(np.uint16))
        camera = tmp_path / "scaled.json"
        camera.write_text(json.dumps(json.loads(frame_files.camera.read_text()) | {"depth_scale": 0.0002}))
        assert np.allclose(load_frame(frame_files.color, path, camera).depth, frame.depth, atol=1e-3)
        doubled = load_frame(frame_files.color, path, camera, depth_scale=0.0004).depth
        assert np.allclose(doubled, 2 * frame.depth, atol=1e-3)

    def test_the_cameras_scale_leaves_float_depth_alone(self, tmp_path, frame_files, frame):
        path = write_depth(tmp_path / "d.npy", frame.depth)
        camera = tmp_path / "scaled.json"
        camera.write_text(json.dumps(json.loads(frame_files.camera.read_text()) | {"depth_scale": 0.001}))
        assert np.array_equal(load_frame(frame_files.color, path, camera).depth, frame.depth)

    def test_no_return_is_zero(self, tmp_path, frame_files, frame):
        values = frame.depth.copy()
        values[0, :4] = [np.nan, np.inf, -np.inf, 0]
        path = write_depth(tmp_path / "d.npy", values)
        assert (load_frame(frame_files.color, path, frame_files.camera).depth[0, :4] == 0).all()

    def test_single_pixels_beyond_all_distances_are_no_return(self, tmp_path, frame_files, frame):
        depth = frame.depth.copy()
        depth[:2, :2] = 1e30
        np.save(tmp_path / "far.npy", depth)
        got = load_frame(frame_files.color, tmp_path / "far.npy", frame_files.camera).depth
        assert (got[:2, :2] == 0).all()
        np.testing.assert_array_equal(got[2:], depth[2:])

    def test_saturated_sixteen_bit_is_no_return(self, tmp_path, frame_files, frame):
        values = (frame.depth * 1000).astype(np.uint16)
        values[3] = 65535
        path = write_depth(tmp_path / "d.png", values)
        got = load_frame(frame_files.color, path, frame_files.camera).depth
        assert (got[3] == 0).all()
        assert (got[4] > 0).all()

    @pytest.mark.parametrize("dtype", ["<u2", ">u2"])
    def test_that_is_so_in_either_byte_order(self, tmp_path, frame_files, frame, dtype):
        values = (frame.depth * 1000).astype(dtype)
        values[3] = 65535
        np.save(tmp_path / "d.npy", values)
        got = load_frame(frame_files.color, tmp_path / "d.npy", frame_files.camera).depth
        assert (got[3] == 0).all()

    @pytest.mark.parametrize(
        ("values", "message"),
        [
            (np.zeros((48, 64), np.uint16), "holds no return at all"),
            (np.full((48, 64), np.nan, np.float32), "holds no return at all"),
            (np.full((48, 64), np.inf, np.float32), "holds no return at all"),
            (np.full((48, 64), 812.0, np.float32), "looks like millimetres; pass --depth-scale 0.001"),
            (np.full((48, 64), 81.2, np.float32), "looks like centimetres; pass --depth-scale 0.01"),
            (np.full((48, 64), 8120, np.uint16), "looks like tenths of a millimetre; pass --depth-scale 0.0001"),
            (np.full((48, 64), 1, np.uint16), "depth scale 0.001 m per unit.*looks like metres"),
            (np.full((48, 64), 0.0008, np.float32), "too near.*--depth-scale"),
            (np.full((48, 64), 60000, np.uint16), "too far"),
            (np.full((48, 64), -0.8, np.float32), "negative in 100.0%"),
            (np.full((48, 64), -800, np.int32), "negative"),
            (np.full((48, 64), 80, np.uint8), "8-bit uint8.*16-bit or float"),
            (np.full((48, 64), True), "8-bit bool"),
            (np.full((48, 64, 3), 80, np.uint16), "shape"),
            (np.full((48, 64), 1j), "complex"),
            (np.full(48, 0.8), "shape"),
            (np.zeros((0, 0), np.uint16), "shape"),
            (np.array([["a"]]), "<U1"),
        ],
    )
    def test_what_cannot_be_depth_is_named(self, tmp_path, frame_files, values, message):
        path = write_depth(tmp_path / "d.npy", values)
        with pytest.raises(InputError, match=message):
            load_frame(frame_files.color, path, frame_files.camera)

    def test_the_advice_in_the_message_works(self, tmp_path, frame_files, frame):
        path = write_depth(tmp_path / "d.npy", frame.depth * 1000)
        got = load_frame(frame_files.color, path, frame_files.camera, depth_scale=0.001)
        assert np.allclose(got.depth, frame.depth)

    def test_a_picture_of_depth_is_refused(self, tmp_path, frame_files):
        Image.fromarray(np.zeros((48, 64, 3), np.uint8)).save(tmp_path / "d.png")
        with pytest.raises(InputError, match="3 channels"):
            load_frame(frame_files.color, tmp_path / "d.png", frame_files.camera)

    @pytest.mark.parametrize("scale", [0, -0.001, float("nan"), float("inf")])
    def test_impossible_scale(self, frame_files, scale):
        with pytest.raises(InputError, match="depth scale must be a positive number"):
            load_frame(frame_files.color, frame_files.depth, frame_files.camera, depth_scale=scale)


class TestBrokenFiles:
    @pytest.mark.parametrize("which", ["color", "depth", "workspace_mask"])
    @pytest.mark.parametrize(
        ("content", "message"),
        [
            (None, "does not exist"),
            ("directory", "is a directory"),
            (b"", "is empty"),
            (b"this is no image", "known format"),
            ("truncated", "cannot be decoded"),
            (b"\x89PNG\r\n\x1a\n", "cannot be decoded"),
        ],
    )
    def test_each_is_one_input_error(self, tmp_path, frame_files, which, content, message):
        path = tmp_path / "broken.png"
        if content == "directory":
            path.mkdir()
        elif content == "truncated":
            noise = np.random.default_rng(0).integers(0, 65535, (48, 64), dtype=np.uint16)
            buffer = io.BytesIO()
            Image.fromarray(noise).save(buffer, "PNG")
            path.write_bytes(buffer.getvalue()[:2000])
        elif content is not None:
            path.write_bytes(content)
        arguments = {"color": frame_files.color, "depth": frame_files.depth, "workspace_mask": None, which: path}
        with pytest.raises(InputError, match=message):
            load_frame(camera=frame_files.camera, **arguments)

    @pytest.mark.parametrize("content", [b"\x93NUMPY", b"\x93NUMPY\x01\x00v\x00{'descr': 'oops", b"PK\x03\x04", b"x"])
    def test_broken_npy(self, tmp_path, frame_files, content):
        (tmp_path / "d.npy").write_bytes(content)
        with pytest.raises(InputError, match="is not a readable"):
            load_frame(frame_files.color, tmp_path / "d.npy", frame_files.camera)

    def test_pickled_npy_is_not_run(self, tmp_path, frame_files):
        np.save(tmp_path / "d.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
        with pytest.raises(InputError, match="is not a readable"):
            load_frame(frame_files.color, tmp_path / "d.npy", frame_files.camera)

    def test_npy_that_claims_more_than_it_holds(self, tmp_path, frame_files):
        header = io.BytesIO()
        np.lib.format.write_array_header_1_0(header, {"descr": "<f4", "fortran_order": False, "shape": (10**6, 10**6)})
        (tmp_path / "d.npy").write_bytes(header.getvalue())
        with pytest.raises(InputError, match="is not a readable"):
            load_frame(frame_files.color, tmp_path / "d.npy", frame_files.camera)

    def test_decompression_bomb(self, tmp_path, frame_files):
        Image.new("1", (20000, 20000)).save(tmp_path / "bomb.png")
        with pytest.raises(InputError, match="megapixels"):
            load_frame(tmp_path / "bomb.png", frame_files.depth, frame_files.camera)

    def test_image_just_above_the_limit(self, tmp_path, frame_files, monkeypatch):
        monkeypatch.setattr(files, "MAX_PIXELS", 64 * 48 - 1)
        with pytest.raises(InputError, match="64x48"):
            load_frame(frame_files.color, frame_files.depth, frame_files.camera)

    @pytest.mark.skipif(os.name != "posix", reason="named pipes are made by mkfifo")
    def test_a_pipe_does_not_hang(self, tmp_path, frame_files):
        os.mkfifo(tmp_path / "pipe")
        with pytest.raises(InputError, match="not a regular file"):
            load_frame(tmp_path / "pipe", frame_files.depth, frame_files.camera)

    def test_a_name_that_no_file_can_have(self, frame_files):
        for name in ("a\0b", "x" * 5000):
            with pytest.raises(InputError):
                load_frame(name, frame_files.depth, frame_files.camera)


class TestSizes:
    def test_colour_and_depth_differ(self, tmp_path, frame_files):
        path = write_depth(tmp_path / "d.png", np.full((24, 32), 800, np.uint16))
        with pytest.raises(InputError, match=r"64x48 but depth .* is 32x24"):
            load_frame(frame_files.color, path, frame_files.camera)

    def test_camera_of_another_size(self, tmp_path, frame_files):
        data = json.loads(frame_files.camera.read_text()) | {"width": 128, "height": 96}
        (tmp_path / "big.json").write_text(json.dumps(data))
        with pytest.raises(InputError, match=r"is for 128x96 images but .* is 64x48"):
            load_frame(frame_files.color, frame_files.depth, tmp_path / "big.json")

    def test_a_camera_without_size_takes_the_images(self, tmp_path, frame_files):
        data = json.loads(frame_files.camera.read_text())
        del data["width"], data["height"]
        (tmp_path / "c.json").write_text(json.dumps(data))
        camera = load_frame(frame_files.color, frame_files.depth, tmp_path / "c.json").camera
        assert (camera.width, camera.height) == (64, 48)
        with pytest.raises(InputError, match="lacks width and height"):
            load_camera(tmp_path / "c.json")


class TestWorkspaceMask:
    @pytest.mark.parametrize("mode", ["1", "L", "RGB", "RGBA", "LA", "P", "I;16"])
    def test_non_zero_is_allowed(self, tmp_path, frame_files, mode):
        allowed = np.zeros((48, 64), np.uint8)
        allowed[10:20, 5:25] = 255
        image = Image.fromarray(allowed)
        if mode == "I;16":
            Image.fromarray(allowed.astype(np.uint16)).save(tmp_path / "m.png")
        else:
            (image if mode == "L" else image.convert(mode)).save(tmp_path / "m.png")
        got = load_frame(frame_files.color, frame_files.depth, frame_files.camera, workspace_mask=tmp_path / "m.png")
        assert got.workspace is not None
        assert np.array_equal(got.workspace, allowed > 0)

    def test_one_counts_as_allowed(self, tmp_path, frame_files):
        Image.fromarray(np.ones((48, 64), np.uint8)).save(tmp_path / "m.png")
        got = load_frame(frame_files.color, frame_files.depth, frame_files.camera, workspace_mask=tmp_path / "m.png")
        assert got.workspace is not None
        assert got.workspace.all()

    @pytest.mark.parametrize(
        ("mask", "message"),
        [
            (np.zeros((48, 64), np.uint8), "allows no pixel"),
            (np.ones((24, 32), np.uint8), "is 32x24 but the images are 64x48"),
        ],
    )
    def test_useless_masks(self, tmp_path, frame_files, mask, message):
        Image.fromarray(mask).save(tmp_path / "m.png")
        with pytest.raises(InputError, match=message):
            load_frame(frame_files.color, frame_files.depth, frame_files.camera, workspace_mask=tmp_path / "m.png")

    def test_no_pixel_with_depth(self, tmp_path, frame_files):
        depth = np.full((48, 64), 800, np.uint16)
        depth[:10] = 0
        mask = np.zeros((48, 64), np.uint8)
        mask[:10] = 1
        path = write_depth(tmp_path / "d.png", depth)
        Image.fromarray(mask).save(tmp_path / "m.png")
        with pytest.raises(InputError, match="allows no pixel with depth"):
            load_frame(frame_files.color, path, frame_files.camera, workspace_mask=tmp_path / "m.png")

    def test_lossy_masks_are_refused(self, tmp_path, frame_files):
        Image.fromarray(np.full((48, 64), 255, np.uint8)).save(tmp_path / "m.jpg")
        with pytest.raises(InputError, match="JPEG"):
            load_frame(frame_files.color, frame_files.depth, frame_files.camera, workspace_mask=tmp_path / "m.jpg")


def test_file_camera_reads_the_same_frame(frame_files, frame):
    camera = FileCamera(color=frame_files.color, depth=frame_files.depth, camera=frame_files.camera)
    assert isinstance(camera, Camera)
    got = camera.read()
    assert np.array_equal(got.color, frame.color)
    assert np.allclose(got.depth, frame.depth, atol=5e-4)


class TestSaving:
    def test_round_trip(self, tmp_path, frame):
        T = np.array([[1, 0, 0, 0.1], [0, -1, 0, 0.2], [0, 0, -1, 0.9], [0, 0, 0, 1.0]])
        depth = frame.depth.copy()
        depth[0, 0] = np.nan
        original = Frame(frame.color, depth, frame.camera, T)
        got = load_frame(*save_frame(original, tmp_path))
        assert np.array_equal(got.color, frame.color)
        assert np.allclose(got.depth[0, 1:], depth[0, 1:], atol=5e-4)
        assert got.depth[0, 0] == 0
        assert got.camera == frame.camera
        assert got.T_world_camera is not None
        assert np.allclose(got.T_world_camera, T)

    def test_depth_beyond_sixteen_bit(self, tmp_path, frame):
        with pytest.raises(InputError, match="16 bit"):
            save_frame(Frame(frame.color, frame.depth + 65, frame.camera), tmp_path)


@needs_real_scenes
class TestRealFrames:
    def test_realsense(self):
        frame = load_frame(
            REAL_SCENES / "000000-color.png", REAL_SCENES / "000000-depth.png", REAL_SCENES / "camera_params.json"
        )
        assert frame.camera == CameraIntrinsics(640, 480, 612.937, 613.173, 322.549, 248.158)
        assert 0.5 < np.median(frame.depth[frame.depth > 0]) < 1.5

    def test_graspnet(self):
        frame = load_frame(
            REAL_SCENES / "graspnet-color.png",
            REAL_SCENES / "graspnet-depth.png",
            REAL_SCENES / "graspnet-meta.mat",
            workspace_mask=REAL_SCENES / "graspnet-workspace_mask.png",
        )
        assert (frame.camera.width, frame.camera.height) == (1280, 720)
        assert frame.camera.fx == pytest.approx(631.5486, abs=1e-3)
        assert 0.3 < np.median(frame.depth[frame.depth > 0]) < 0.7
        assert frame.workspace is not None

    def test_nested_camera(self):
        camera, scale, pose = load_camera(REAL_SCENES / "annotations.json")
        assert (camera.width, camera.cx, scale, pose) == (640, 322.549, 0.001, None)
