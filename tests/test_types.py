"""The dataclasses refuse what they must not hold, and say what arrived."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
from fakes.stages import FakeScene, table_frame

from thinkgrasp.errors import ContractError, InputError
from thinkgrasp.types import CameraIntrinsics, Frame, Grasp, Grasps, Obstruction, Plan, SupportPlane, Usage

GOOD = {"width": 64, "height": 48, "fx": 100.0, "fy": 100.0, "cx": 31.5, "cy": 23.5}


class TestCamera:
    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"width": 0}, "size must be positive, got 0x48"),
            ({"fx": 0.0}, "fx must be positive"),
            ({"fy": -1.0}, "fy must be positive"),
            ({"fx": float("nan")}, "fx must be positive"),
            ({"fy": float("inf")}, "fy must be positive"),
            ({"cx": 64.0}, "cx=64.0 lies outside the image"),
            ({"cy": -0.1}, "cy=-0.1 lies outside"),
            ({"cx": float("nan")}, "cx=nan lies outside"),
        ],
    )
    def test_impossible_cameras(self, changes, message):
        with pytest.raises(InputError, match=message):
            CameraIntrinsics(**(GOOD | changes))

    def test_the_principal_point_projects_to_itself(self):
        camera = CameraIntrinsics(**GOOD)
        assert np.array_equal(camera.project(np.array([0.0, 0, 2.0])), [31.5, 23.5])


class TestFrame:
    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"color": np.zeros((48, 64, 4), np.uint8)}, "colour must be"),
            ({"color": np.zeros((48, 64, 3), np.float32)}, "colour must be"),
            ({"depth": np.zeros((48, 64))}, "depth must be"),
            ({"depth": np.zeros((24, 32), np.float32)}, "colour is 64x48 but depth is 32x24"),
            ({"camera": CameraIntrinsics(32, 24, 50, 50, 15, 11)}, "images are 64x48 but the camera is 32x24"),
            ({"workspace": np.ones((48, 64), np.uint8)}, "workspace mask must be 64x48 boolean"),
            ({"workspace": np.ones((2, 2), bool)}, "workspace mask must be"),
            ({"T_world_camera": np.eye(3)}, "finite 4x4"),
            ({"T_world_camera": np.full((4, 4), np.nan)}, "finite 4x4"),
            ({"T_world_camera": np.diag([1.0, 1, -1, 1])}, "rigid transform"),
        ],
    )
    def test_impossible_frames(self, changes, message):
        with pytest.raises(InputError, match=message):
            replace(table_frame(), **changes)

    def test_frozen(self):
        with pytest.raises(FrozenInstanceError):
            table_frame().depth = np.zeros((48, 64), np.float32)  # type: ignore[misc]


class TestGrasps:
    def batch(self, n: int = 3) -> Grasps:
        rng = np.random.default_rng(0)
        f = np.float32
        return Grasps(
            np.broadcast_to(np.eye(3, dtype=f), (n, 3, 3)), rng.random((n, 3), f), rng.random(n, f), rng.random(n, f)
        )

    @pytest.mark.parametrize(
        ("name", "value"),
        [
            ("rotations", np.zeros((2, 3, 3), np.float32)),
            ("widths", np.zeros((3, 1), np.float32)),
            ("scores", np.zeros(3)),
            ("positions", np.zeros((3, 4), np.float32)),
        ],
    )
    def test_disagreeing_arrays(self, name, value):
        with pytest.raises(ContractError, match=rf"Grasps.{name} must be"):
            replace(self.batch(), **{name: value})

    def test_indexing_and_iteration(self):
        grasps = self.batch()
        kept = grasps[np.array([True, False, True])]
        assert len(kept) == 2
        assert [g.score for g in kept] == [float(grasps.scores[0]), float(grasps.scores[2])]
        assert len(Grasps.empty()) == 0
        assert list(Grasps.empty()) == []

    def test_pregrasp_lies_back_along_the_approach(self):
        R = np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]])
        grasp = Grasp(R, np.array([0.1, 0.2, 0.3]), 0.05, 0.9)
        assert np.allclose(grasp.pregrasp(0.1), [0.0, 0.2, 0.3])

    def test_batches_are_joined_best_first_and_ties_keep_their_order(self):
        def batch(*scores: float) -> Grasps:
            n = len(scores)
            places = np.arange(3 * n, dtype=np.float32).reshape(n, 3) + 100 * scores[0]
            rotations = np.repeat(np.eye(3, dtype=np.float32)[None], n, axis=0)
            return Grasps(rotations, places, np.zeros(n, np.float32), np.array(scores, np.float32))

        a, b = batch(0.5, 0.9), batch(0.7, 0.5)
        joined = Grasps.concatenate([a, Grasps.empty(), b])
        np.testing.assert_array_equal(joined.scores, np.array([0.9, 0.7, 0.5, 0.5], np.float32))
        np.testing.assert_array_equal(joined.positions[2], a.positions[0])
        assert len(Grasps.concatenate([])) == 0


class TestScene:
    def test_wrong_mark_lists_those_that_exist(self):
        scene = FakeScene().perceive(table_frame())
        assert scene.proposal(2).mark == 2
        with pytest.raises(ContractError, match=r"no proposal has mark 9; marks in this scene: \[1, 2\]"):
            scene.proposal(9)

    def test_what_is_in_the_way(self):
        hides = Obstruction("hides", 1, 2, 50, "px")
        rests = Obstruction("rests_on", 3, 2, 0.001, "m")
        scene = replace(FakeScene().perceive(table_frame()), obstructions=(hides, rests))
        assert scene.obstructing(2) == (hides, rests)
        assert scene.obstructing(1) == scene.obstructing(3) == ()

    def test_height_above_the_support(self):
        plane = SupportPlane(np.array([0, 0, -1.0]), 0.8, np.ones((1, 1), bool), 0.0)
        heights = plane.height(np.array([[0, 0, 0.8], [0, 0, 0.7]], np.float32))
        assert heights.dtype == np.float32
        assert np.allclose(heights, [0, 0.1])


@pytest.mark.parametrize(("grid", "cell"), [(3, 0), (3, 10), (0, 1), (2, 5)])
def test_plan_cell_must_be_in_the_grid(grid, cell):
    with pytest.raises(ContractError, match="outside 1"):
        Plan("mug", "why", grid=grid, cell=cell)


def test_frame_accepts_nan_depth():
    frame = table_frame()
    depth = frame.depth.copy()
    depth[:5] = np.nan
    assert isinstance(replace(frame, depth=depth), Frame)


def test_usage_adds_up_and_unknown_costs_stay_unknown():
    known, unknown = Usage("a", 10, 1, 0.5, 1, 2.0), Usage("b", 10, 1, None, 2, 1.0)
    offline = Usage()
    assert known + known == Usage("a", 20, 2, 1.0, 2, 4.0)
    assert offline + known == known + offline == known
    assert known + unknown == Usage("b", 20, 2, None, 3, 3.0)
    assert offline + offline == offline
