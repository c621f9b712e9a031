"""AX = XB on poses whose truth is known, and on poses that determine nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fakes.boards import T_BASE_BOARD, T_BASE_CAMERA, T_FLANGE_BOARD, T_FLANGE_CAMERA, samples
from scipy.spatial.transform import Rotation

pytest.importorskip("cv2", reason="needs thinkgrasp[calibration]")

from thinkgrasp.errors import InputError
from thinkgrasp.geometry import invert, make_transform
from thinkgrasp.handeye.session import report_lines
from thinkgrasp.handeye.solve import MIN_POSES, Sample, solve

TRUTH = {"fixed": (T_BASE_CAMERA, T_FLANGE_BOARD), "hand": (T_FLANGE_CAMERA, T_BASE_BOARD)}
MOUNTS = ("fixed", "hand")


def apart(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """Distance [mm] and turn [deg] between two poses."""
    d = invert(a) @ b
    return float(np.linalg.norm(d[:3, 3])) * 1e3, float(np.degrees(Rotation.from_matrix(d[:3, :3]).magnitude()))


@pytest.mark.parametrize("mount", MOUNTS)
def test_exact_poses_give_the_exact_place(mount):
    found = solve(samples(mount), mount)
    X, Z = TRUTH[mount]
    assert apart(X, found.T_camera) == pytest.approx((0, 0), abs=1e-6)
    assert apart(Z, found.T_board) == pytest.approx((0, 0), abs=1e-6)
    assert found.held_out_mm.max() < 1e-6
    assert found.outliers == ()


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("seed", range(2))
def test_noise_of_a_millimetre_leaves_a_few(mount, seed):
    found = solve(samples(mount, 20, seed=seed, noise_mm=1.0, noise_deg=0.1), mount)
    mm, deg = apart(TRUTH[mount][0], found.T_camera)
    assert mm < 3.0
    assert deg < 0.3


def test_the_error_is_honest():
    """What is reported was not fitted to: it is larger than the fitted error, and about the noise that was put in."""
    found = solve(samples("fixed", 15, noise_mm=1.0, noise_deg=0.1), "fixed")
    assert found.median_mm > found.fitted_mm
    assert 1.0 < found.median_mm < 3.5  # three axes of 1 mm
    assert 0.08 < found.median_deg < 0.35
    lines = " ".join(report_lines(found))
    assert f"median {found.median_mm:.2f} mm" in lines
    assert "no measure of accuracy" in lines


def test_a_board_that_slipped_is_named():
    poses = samples("fixed", 15, noise_mm=0.3, noise_deg=0.03)
    slipped = poses[6].T_camera_board @ make_transform(np.eye(3), np.array([0.03, 0.0, 0.0]))
    poses[6] = replace(poses[6], T_camera_board=slipped)
    found = solve(poses, "fixed")
    assert found.outliers == ("007",)
    assert "007" in report_lines(found)[-1]


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_turns_about_one_axis_are_refused(mount, axis):
    poses = samples(mount, 15, axes=axis, most_deg=60.0, noise_mm=0.5, noise_deg=0.05)
    with pytest.raises(InputError, match=r"turned about one axis .* tilt the board about a second axis"):
        solve(poses, mount)


def test_moves_without_turns_are_refused():
    with pytest.raises(InputError, match="turned too little"):
        solve(samples("fixed", 15, most_deg=3.0), "fixed")


def test_too_few_poses_are_refused():
    with pytest.raises(InputError, match=f"{MIN_POSES - 1} usable poses are too few; at least {MIN_POSES}"):
        solve(samples("fixed", MIN_POSES - 1), "fixed")


def repeated(poses: list[Sample], times: int) -> list[Sample]:
    """The same places of the arm again and again, the board seen with noise of its own each time."""
    rng, made = np.random.default_rng(1), []
    for k in range(times):
        for s in poses:
            seen = s.T_camera_board.copy()
            seen[:3, 3] += 1e-5 * rng.normal(size=3)
            made.append(replace(s, T_camera_board=seen, name=f"{s.name}-{k}"))
    return made


def test_one_pose_taken_again_and_again_is_one_pose():
    few = samples("fixed", 4, noise_mm=3.0, noise_deg=0.3)
    with pytest.raises(
        InputError, match=r"of 16 poses only 4 are more than 3 deg or 10 mm from one another; at least 8"
    ):
        solve(repeated(few, 4), "fixed")


def test_a_pose_that_was_repeated_does_not_make_the_error_look_smaller():
    """What is left out is left out with its repetitions."""
    poses = samples("fixed", MIN_POSES, noise_mm=3.0, noise_deg=0.3)
    once, often = solve(poses, "fixed"), solve(repeated(poses, 2), "fixed")
    assert often.median_mm == pytest.approx(once.median_mm, rel=0.05)
    assert often.median_deg == pytest.approx(once.median_deg, rel=0.05)


def test_poses_that_are_none_are_refused():
    poses = samples("fixed")
    poses[3] = replace(poses[3], T_base_flange=np.full((4, 4), np.nan))
    with pytest.raises(InputError, match="pose 004 of the arm is no finite 4x4 matrix"):
        solve(poses, "fixed")


def test_the_other_mount_does_not_fit():
    found = solve(samples("fixed", 9, noise_mm=0.5, noise_deg=0.05), "hand")
    assert found.median_mm > 20, "a wrong mount shows in the error"
