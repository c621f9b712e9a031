"""What a calibration leaves in the camera file, and what a run makes of files that people edited."""

from __future__ import annotations

import json

import numpy as np
import pytest
from fakes.boards import CAMERA, T_BASE_CAMERA, T_FLANGE_CAMERA

from thinkgrasp.cameras.calibration import read_calibration
from thinkgrasp.errors import InputError
from thinkgrasp.geometry import make_transform
from thinkgrasp.handeye.board import Board
from thinkgrasp.handeye.camera_file import read_pose, read_record, write_camera_file
from thinkgrasp.handeye.solve import HandEye

T_WORLD_BASE = make_transform(np.eye(3), np.array([0.1, -0.2, 0.05]))


def result(mount: str) -> HandEye:
    X = T_BASE_CAMERA if mount == "fixed" else T_FLANGE_CAMERA
    names = tuple(f"{i:03d}" for i in range(9))
    return HandEye(mount, X, np.eye(4), "park", np.full(9, 1.5), np.full(9, 0.2), 1.0, names)  # type: ignore[arg-type]


def test_a_fixed_cameras_pose_is_in_the_world_and_the_file_is_a_camera_file(tmp_path):
    path = tmp_path / "camera.json"
    path.write_text(json.dumps({"depth_scale": 0.00025, "note": "left one", "T_flange_camera": np.eye(4).tolist()}))
    write_camera_file(path, CAMERA, result("fixed"), Board(), T_WORLD_BASE)
    read = read_calibration(path)
    np.testing.assert_allclose(read.T_world_camera, T_WORLD_BASE @ T_BASE_CAMERA)
    assert read.intrinsics((640, 480)) == CAMERA
    assert read.depth_scale == 0.00025
    data = json.loads(path.read_text())
    assert data["note"] == "left one"
    assert "T_flange_camera" not in data, "of two poses one would be wrong"
    np.testing.assert_allclose(read_pose(path, "fixed"), T_WORLD_BASE @ T_BASE_CAMERA)
    record = read_record(path)
    assert record is not None
    assert (record.mount, record.held_out_mm, record.held_out_deg, record.poses) == ("fixed", 1.5, 0.2, 9)
    np.testing.assert_allclose(record.T_world_base, T_WORLD_BASE)


def test_a_camera_on_the_hand_has_its_pose_on_the_flange(tmp_path):
    path = tmp_path / "new.json"
    write_camera_file(path, CAMERA, result("hand"), Board(), T_WORLD_BASE)
    np.testing.assert_allclose(read_pose(path, "hand"), T_FLANGE_CAMERA)
    assert read_calibration(path).T_world_camera is None
    with pytest.raises(InputError, match=r"lacks T_world_camera, .* mounted 'fixed' .* thinkgrasp calibrate"):
        read_pose(path, "fixed")


def test_a_file_without_record_says_nothing(tmp_path):
    path = tmp_path / "camera.json"
    path.write_text(json.dumps({"fx": 1}))
    assert read_record(path) is None


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[1]", "must hold a JSON object"),
        ("{", "not readable JSON"),
        ('{"T_world_camera": "here"}', "4 rows of 4 numbers"),
        ('{"T_world_camera": [[1, 0], [0, 1]]}', "4 rows of 4 finite numbers"),
        (json.dumps({"T_world_camera": np.full((4, 4), 1e400).tolist()}), "finite"),
        (json.dumps({"T_world_camera": (2 * np.eye(4)).tolist()}), "the last 0 0 0 1"),
        (json.dumps({"T_world_camera": np.diag([1.0, 1, -1, 1]).tolist()}), "right-handed"),
    ],
)
def test_poses_that_are_none(tmp_path, content, message):
    path = tmp_path / "camera.json"
    path.write_text(content)
    with pytest.raises(InputError, match=message):
        read_pose(path, "fixed")


@pytest.mark.parametrize(
    "record", [5, {}, {"mount": "fixed", "T_world_base": 1}, {"mount": ["hand"]}, {"mount": "wall"}]
)
def test_records_that_are_none(tmp_path, record):
    path = tmp_path / "camera.json"
    path.write_text(json.dumps({"hand_eye": record}))
    with pytest.raises(InputError, match="hand_eye"):
        read_record(path)
