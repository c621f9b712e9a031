from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
from fakes.stages import table_frame

from thinkgrasp.checks.reach import ReachCheck
from thinkgrasp.errors import ConfigError, MissingDependency
from thinkgrasp.geometry import deproject, invert, make_transform
from thinkgrasp.gripper import GRIPPERS
from thinkgrasp.types import Grasps, Scene, Segment

GRIPPER = GRIPPERS["robotiq_2f85"]
TARGET = Segment("thing", 1.0, np.zeros((48, 64), bool), (0, 0, 1, 1), False)
DOWN = np.diag([1.0, -1.0, -1.0])
T_WORLD_CAMERA = make_transform(DOWN, np.array([0.5, 0.0, 0.6]))  # looking straight down


def scene(T_world_camera: np.ndarray | None = T_WORLD_CAMERA, *, cloud: np.ndarray | None = None) -> Scene:
    frame = replace(table_frame(), T_world_camera=T_world_camera)
    empty = np.full((48, 64, 3), np.nan, np.float32)
    return Scene(frame, empty if cloud is None else cloud)


def grasps_at(*positions: tuple[float, float, float], approach_up: bool = False) -> Grasps:
    """Straight down at world positions, scores falling."""
    n = len(positions)
    R = np.eye(3) if approach_up else DOWN
    T = [invert(T_WORLD_CAMERA) @ make_transform(R, np.array(p)) for p in positions]
    return Grasps(
        np.array([t[:3, :3] for t in T], np.float32).reshape(n, 3, 3),
        np.array([t[:3, 3] for t in T], np.float32).reshape(n, 3),
        np.full(n, 0.06, np.float32),
        np.linspace(0.9, 0.1, n).astype(np.float32),
    )


@pytest.fixture(scope="module")
def check() -> ReachCheck:
    pytest.importorskip("mujoco", reason="needs the sim extra")
    return ReachCheck()


def test_keeps_what_is_in_reach(check: ReachCheck) -> None:
    grasps = grasps_at((0.5, 0.0, 0.03), (1.4, 0.0, 0.03), (0.4, -0.2, 0.05), (0.5, 0.0, -0.04))
    np.testing.assert_array_equal(check.keep(scene(), TARGET, grasps, GRIPPER), [True, False, True, False])


def test_drops_what_comes_out_of_the_table(check: ReachCheck) -> None:
    assert not check.keep(scene(), TARGET, grasps_at((0.5, 0.0, 0.1), approach_up=True), GRIPPER).any()


def test_drops_what_the_cloud_blocks(check: ReachCheck) -> None:
    frame = replace(table_frame(), T_world_camera=T_WORLD_CAMERA)
    near = deproject(np.full((48, 64), 0.15, np.float32), frame.camera)  # everything 0.45 m above the table
    grasps = grasps_at((0.5, 0.0, 0.03))
    assert check.keep(scene(), TARGET, grasps, GRIPPER).all()
    assert not check.keep(scene(cloud=near), TARGET, grasps, GRIPPER).any()


def test_best_first_and_no_more_than_asked() -> None:
    pytest.importorskip("mujoco", reason="needs the sim extra")
    grasps = grasps_at(*[(0.5, 0.0, 0.03)] * 4)
    worst_first = grasps[np.arange(4)[::-1]]
    keep = ReachCheck(max_kept=2).keep(scene(), TARGET, worst_first, GRIPPER)
    np.testing.assert_array_equal(keep, [False, False, True, True])


def test_no_grasps(check: ReachCheck) -> None:
    assert check.keep(scene(), TARGET, Grasps.empty(), GRIPPER).shape == (0,)


def test_without_a_camera_pose_nothing_can_be_said(check: ReachCheck) -> None:
    with pytest.raises(ConfigError, match="T_world_camera"):
        check.keep(scene(None), TARGET, grasps_at((0.5, 0.0, 0.03)), GRIPPER)


def test_settings_out_of_range() -> None:
    with pytest.raises(ConfigError, match="max_kept"):
        ReachCheck(max_kept=0)


def test_missing_library_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("thinkgrasp.motion.arm", "thinkgrasp.motion.collision", "thinkgrasp.motion.arm_spec"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(MissingDependency, match=r"pip install 'thinkgrasp\[sim\]'"):
        ReachCheck()
