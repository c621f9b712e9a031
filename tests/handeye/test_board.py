"""Boards found in rendered pictures, and pictures from which no pose should be taken."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("cv2", reason="needs thinkgrasp[calibration]")

from fakes.boards import CAMERA, photo

from thinkgrasp.errors import ConfigError
from thinkgrasp.geometry import invert, make_transform
from thinkgrasp.handeye import board as board_module
from thinkgrasp.handeye.board import Board, BoardFinder, BoardView

TAG = "DICT_APRILTAG_36h11"
BOARDS = {
    "charuco": Board(),
    "apriltag": Board("apriltag", marker_m=0.1, dictionary=TAG, tag_id=7),
    "grid": Board("apriltag_grid", 4, 3, marker_m=0.04, gap_m=0.01, dictionary=TAG),
}
TILTS = {"ahead": (2, -3, 0), "tilted": (25, -30, 40), "upside down": (-20, 15, 175)}


def place(name: str, tilt: tuple[float, float, float], z: float = 0.5) -> np.ndarray:
    """T_camera_board with the middle of the board before the camera."""
    R = Rotation.from_euler("xyz", tilt, degrees=True).as_matrix()
    board = BOARDS[name]
    middle = {
        "charuco": np.array([board.columns * board.square_m, board.rows * board.square_m, 0]) / 2,
        "apriltag": np.zeros(3),
        "grid": np.array([0.19, 0.14, 0]) / 2,
    }[name]
    return make_transform(R, np.array([0.0, 0.0, z]) - R @ middle)


def apart(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    d = invert(a) @ b
    return float(np.linalg.norm(d[:3, 3])) * 1e3, float(np.degrees(Rotation.from_matrix(d[:3, :3]).magnitude()))


@pytest.mark.parametrize("tilt", ["tilted", "upside down"])
@pytest.mark.parametrize("name", BOARDS)
def test_finds_the_pose(name, tilt):
    T = place(name, TILTS[tilt])
    seen = BoardFinder(BOARDS[name]).find(photo(BOARDS[name], T), CAMERA)
    assert isinstance(seen, BoardView), seen
    mm, deg = apart(T, seen.T_camera_board)
    assert mm < 1.5
    assert deg < 0.6
    assert seen.reprojection_px < 0.4


def test_a_half_hidden_charuco_board_is_found_and_a_hidden_one_is_not():
    T = place("charuco", TILTS["tilted"])
    picture = photo(BOARDS["charuco"], T)
    finder = BoardFinder(BOARDS["charuco"])
    half = picture.copy()
    half[:, :290] = 90
    seen = finder.find(half, CAMERA)
    assert isinstance(seen, BoardView), seen
    assert 8 <= len(seen.corners_px) < 24
    assert apart(T, seen.T_camera_board)[0] < 3
    assert "corners of the board are in view" in str(finder.find(np.full_like(picture, 90), CAMERA))


def test_another_tag_is_not_taken_for_the_board():
    picture = photo(BOARDS["apriltag"], place("apriltag", TILTS["tilted"]))
    other = Board("apriltag", marker_m=0.1, dictionary=TAG, tag_id=8)
    assert "tag 8 is in view 0 times" in str(BoardFinder(other).find(picture, CAMERA))


def test_a_board_that_is_too_far_is_refused():
    T = place("apriltag", TILTS["tilted"], z=3.0)
    assert isinstance(BoardFinder(BOARDS["apriltag"]).find(photo(BOARDS["apriltag"], T), CAMERA), str)


@pytest.mark.parametrize("tilt_deg", [2, 6, 12])
def test_a_small_tag_is_never_taken_for_its_mirror_image(tilt_deg):
    """Two tilts of a small square nearly fit the same corners: the pose is right to some degrees, or refused."""
    T = place("apriltag", (tilt_deg, 0, 0), z=1.6)
    for seed in range(3):
        seen = BoardFinder(BOARDS["apriltag"]).find(photo(BOARDS["apriltag"], T, seed=seed, noise=6), CAMERA)
        assert isinstance(seen, str) or apart(T, seen.T_camera_board)[1] < 8


def test_wrong_sizes_do_not_fit_a_charuco_board():
    """A board described with the wrong ratio of squares to markers is still a chessboard, but its scale is wrong."""
    picture = photo(BOARDS["charuco"], place("charuco", TILTS["tilted"]))
    twice = Board(square_m=0.06, marker_m=0.044)
    seen = BoardFinder(twice).find(picture, CAMERA)
    assert isinstance(seen, BoardView)
    assert seen.T_camera_board[2, 3] == pytest.approx(2 * place("charuco", TILTS["tilted"])[2, 3], rel=0.02)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Board(square_m=0.02, marker_m=0.03), "markers smaller than"),
        (lambda: Board(columns=2), "at least 3x3 squares"),
        (lambda: Board("apriltag_grid", 1, 1), "at least two tags"),
        (lambda: Board(square_m=float("nan")), r"must lie in \(0, 1\) m"),
        (lambda: Board(tag_id=-1), "at least 0"),
        (lambda: BoardFinder(Board(dictionary="DICT_9X9")), "no dictionary 'DICT_9X9'; allowed are DICT_4X4_100"),
        (lambda: BoardFinder(Board(dictionary="Board")), "no dictionary 'Board'"),
        (lambda: BoardFinder(Board(columns=12, rows=12)), "has 50 markers, the board needs 72"),
        (lambda: BoardFinder(Board()).picture(100.0), "cannot be drawn"),
    ],
)
def test_boards_that_are_none(make, message):
    with pytest.raises(ConfigError, match=message):
        make()


@pytest.mark.parametrize("name", BOARDS)
def test_the_picture_to_print_has_its_true_size(name):
    board, px_per_m = BOARDS[name], 300 / 0.0254
    picture = BoardFinder(board).picture(px_per_m)
    dark = np.nonzero((picture < 128).any(axis=0))[0]
    width = {"charuco": 7 * 0.03, "apriltag": 0.1, "grid": 0.19}[name]
    assert (dark[-1] - dark[0] + 1) / px_per_m == pytest.approx(width, abs=5e-4)


def test_an_opencv_without_hand_eye_is_named(monkeypatch):
    import cv2

    monkeypatch.delattr(cv2, "calibrateHandEye")
    with pytest.raises(ConfigError, match=r"lacks calibrateHandEye .* 'opencv-python-headless>=4.7,<5'"):
        board_module.opencv()
