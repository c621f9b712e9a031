from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from fakes.stages import camera_dict, table_frame
from fakes.table_loop import POSE

from thinkgrasp.cameras.calibration import Calibration
from thinkgrasp.cameras.placed import PlacedCamera
from thinkgrasp.errors import InputError
from thinkgrasp.geometry import make_transform


class Fixed:
    def __init__(self, **changes: Any) -> None:
        self.changes = changes

    def read(self):
        return replace(table_frame(T_world_camera=None), **self.changes)


def test_frames_get_the_pose_and_the_mask():
    low_high = np.array([[-0.05, -10.0, -10.0], [0.05, 10.0, 10.0]])
    frame = PlacedCamera(Fixed(), lambda: POSE, workspace_m=low_high).read()
    np.testing.assert_array_equal(frame.T_world_camera, POSE)
    assert frame.workspace is not None
    assert 0 < frame.workspace.mean() < 0.5
    assert frame.workspace[:, frame.workspace.shape[1] // 2].any()


def test_pixels_without_depth_are_not_in_the_workspace():
    depth = table_frame().depth.copy()
    depth[10] = 0
    box = np.array([[-9.0] * 3, [9.0] * 3])
    frame = PlacedCamera(Fixed(depth=depth), lambda: POSE, workspace_m=box).read()
    assert frame.workspace is not None
    assert not frame.workspace[10].any()
    assert frame.workspace[11].all()


@pytest.mark.parametrize(
    "step", [make_transform(np.eye(3), np.array([0.003, 0, 0])), np.diag([1.0, -1, -1, 1])], ids=["moved", "turned"]
)
def test_a_camera_that_moves_while_it_looks(step):
    poses = [POSE, POSE @ step]
    with pytest.raises(InputError, match="while its camera looked; it has to stand still"):
        PlacedCamera(Fixed(), lambda: poses.pop(0)).read()


def calibration(**changes: Any) -> Calibration:
    c = camera_dict()
    made = Calibration(c["fx"], c["fy"], c["cx"], c["cy"], (c["width"], c["height"]), None, None)
    return replace(made, **changes)


def test_the_file_of_another_camera_is_refused():
    PlacedCamera(Fixed(), lambda: POSE, calibration=calibration()).read()
    with pytest.raises(InputError, match=r"says fx = .* is it the file of this camera"):
        PlacedCamera(Fixed(), lambda: POSE, calibration=calibration(fx=999.0)).read()
    with pytest.raises(InputError, match="the camera file is for 1280x720, but the camera gives"):
        PlacedCamera(Fixed(), lambda: POSE, calibration=calibration(size_wh=(1280, 720))).read()
