"""Camera files in every accepted spelling, and what is said about the others."""

from __future__ import annotations

import json

import numpy as np
import pytest
from fakes.stages import camera_dict
from scipy.io import savemat

from thinkgrasp.cameras.files import load_camera
from thinkgrasp.errors import InputError
from thinkgrasp.types import CameraIntrinsics

EXPECTED = CameraIntrinsics(64, 48, 100.0, 101.0, 31.5, 23.5)
K = [[100.0, 0, 31.5], [0, 101.0, 23.5], [0, 0, 1]]
K_ROWS = [x for row in K for x in row]
K_COLUMNS = [x for row in np.transpose(K).tolist() for x in row]
SIZE = {"width": 64, "height": 48}


@pytest.mark.parametrize(
    "data",
    [
        {**SIZE, "fx": 100, "fy": 101, "cx": 31.5, "cy": 23.5},
        {"img_width": 64, "img_height": 48, "fx": 100.0, "fy": 101.0, "x_offset": 31.5, "y_offset": 23.5},
        {**SIZE, "fx": 100, "fy": 101, "ppx": 31.5, "ppy": 23.5, "coeffs": [0, 0, 0, 0, 0]},
        {"width": 64.0, "height": 48.0, "K": K},
        {**SIZE, "intrinsic_matrix": K},
        {**SIZE, "camera_matrix": K_ROWS},
        {**SIZE, "k": K_ROWS, "d": [0.0] * 5, "distortion_model": "plumb_bob", "p": [0.0] * 12},
        {**SIZE, "K": K_ROWS, "D": []},
        {**SIZE, "intrinsic_matrix": K_COLUMNS},
        {"camera": {**SIZE, "fx": 100, "fy": 101, "cx": 31.5, "cy": 23.5}, "scenes": {}},
        {"intrinsic": {**SIZE, "intrinsic_matrix": K_COLUMNS}},
    ],
)
def test_spellings(tmp_path, data):
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(data))
    assert load_camera(path) == (EXPECTED, None, None)


def test_byte_order_mark(tmp_path):
    (tmp_path / "c.json").write_bytes(b"\xef\xbb\xbf" + json.dumps(camera_dict()).encode())
    assert load_camera(tmp_path / "c.json")[0].width == 64


def test_depth_scale_and_pose(tmp_path):
    T = [[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]]
    (tmp_path / "c.json").write_text(json.dumps(camera_dict(depth_scale=0.0002, T_world_camera=T)))
    _, scale, pose = load_camera(tmp_path / "c.json")
    assert scale == 0.0002
    assert np.array_equal(pose, T)


def test_graspnet_meta(tmp_path):
    from thinkgrasp.cameras.calibration import read_calibration

    savemat(tmp_path / "meta.mat", {"intrinsic_matrix": np.array(K), "factor_depth": np.array([[1000]])})
    calibration = read_calibration(tmp_path / "meta.mat")
    assert calibration.intrinsics((64, 48)) == EXPECTED
    assert calibration.depth_scale == 0.001


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fx": None}, "lacks fx"),
        ({"fx": None, "cy": None}, "lacks fx, cy"),
        ({"fx": "100"}, 'fx must be a number, got "100"'),
        ({"fx": True}, "fx must be a number, got true"),
        ({"fx": [100]}, "fx must be a number"),
        ({"fx": float("nan")}, "fx must be finite"),
        ({"fx": float("inf")}, "fx must be finite"),
        ({"fx": 10**400}, "fx must be finite"),
        ({"fx": 0}, "focal length fx must be positive"),
        ({"fy": -600.0}, "focal length fy must be positive"),
        ({"cx": 64.5}, "principal point cx=64.5 lies outside"),
        ({"cy": -1}, "principal point cy=-1"),
        ({"width": 0}, "width must be a positive whole number"),
        ({"width": -64}, "width must be a positive whole number"),
        ({"width": 64.5}, "width must be a positive whole number"),
        ({"width": "64"}, "width must be a number"),
        ({"width": None}, "only one of width and height"),
        ({"depth_scale": 0}, "depth scale must be a positive"),
        ({"depth_scale": -0.001}, "depth scale must be a positive"),
        ({"depth_scale": "mm"}, "depth_scale must be a number"),
        ({"T_world_camera": [[1, 0], [0, 1]]}, "4 rows of 4 numbers"),
        ({"T_world_camera": "identity"}, "4 rows of 4 numbers"),
        ({"T_world_camera": (2 * np.eye(4)).tolist()}, "rigid transform"),
        ({"T_world_camera": np.diag([1.0, 1, -1, 1]).tolist()}, "rigid transform"),
        ({"T_world_camera": [[1, 0, 0, "x"], *np.eye(4).tolist()[1:]]}, "must be a number"),
        ({"D": [0.1, 0, 0, 0, 0]}, "lens distortion"),
    ],
)
def test_wrong_values(tmp_path, changes, message):
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(camera_dict(**changes)))
    with pytest.raises(InputError, match=message) as caught:
        load_camera(path)
    assert str(path) in str(caught.value)


def test_null_is_named(tmp_path):
    (tmp_path / "c.json").write_text(json.dumps(camera_dict() | {"fx": None}))
    with pytest.raises(InputError, match="fx must be a number, got null"):
        load_camera(tmp_path / "c.json")


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (K_ROWS[:8], "9 numbers, got 8"),
        ([[1, 2, 3]] * 3, r"must be \[\[fx, 0, cx\]"),
        ([[100, 5, 31.5], [0, 101, 23.5], [0, 0, 1]], "skew"),
        ([["a"] * 3] * 3, "must be a number"),
    ],
)
def test_wrong_matrices(tmp_path, matrix, message):
    (tmp_path / "c.json").write_text(json.dumps({**SIZE, "K": matrix}))
    with pytest.raises(InputError, match=message):
        load_camera(tmp_path / "c.json")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty"),
        (b"{", "not readable JSON"),
        (b"[1, 2]", "must hold a JSON object"),
        (b"null", "must hold a JSON object"),
        (b"\xff\xfe\x00", "not readable JSON"),
        (b"[" * 100_000, "not readable JSON"),
        (b"{}", "lacks fx, fy, cx, cy"),
    ],
)
def test_broken_files(tmp_path, content, message):
    (tmp_path / "c.json").write_bytes(content)
    with pytest.raises(InputError, match=message):
        load_camera(tmp_path / "c.json")


def test_broken_mat_files(tmp_path):
    (tmp_path / "a.mat").write_bytes(b"MATLAB 5.0 nonsense" * 20)
    with pytest.raises(InputError, match="not a readable MATLAB file"):
        load_camera(tmp_path / "a.mat")
    savemat(tmp_path / "b.mat", {"poses": np.eye(3)})
    with pytest.raises(InputError, match="lacks intrinsic_matrix; it has poses"):
        load_camera(tmp_path / "b.mat")
    savemat(tmp_path / "c.mat", {"intrinsic_matrix": np.array(K), "factor_depth": np.array([[0]])})
    with pytest.raises(InputError, match="factor_depth must be positive"):
        load_camera(tmp_path / "c.mat")


def test_missing_and_directory(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        load_camera(tmp_path / "none.json")
    with pytest.raises(InputError, match="is a directory"):
        load_camera(tmp_path)
