"""Calibration boards: ChArUco, a single AprilTag, and a grid of AprilTags; found in a picture with sub-pixel corners.

Board frame: as OpenCV draws boards, x right and y down on the printed side, z into the board.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import ConfigError, MissingDependency
from thinkgrasp.geometry import make_transform
from thinkgrasp.types import CameraIntrinsics

Float = NDArray[np.float64]

Kind = Literal["charuco", "apriltag", "apriltag_grid"]
MIN_CORNERS = 8
"""Of a ChArUco board; a view that shows fewer is not used."""
MAX_REPROJECTION_PX = 1.5
"""A pose whose corners fit worse (root mean square) is not used."""
MIN_AREA_SHARE = 0.003
"""Of the picture that the corners have to span: a pose from a small patch of pixels is too uncertain."""


def opencv() -> Any:
    """Return OpenCV with its ArUco and hand-eye functions.

    Raises:
        MissingDependency: It is not installed.
        ConfigError: It is a build without them.
    """
    try:
        import cv2
    except ModuleNotFoundError as error:
        raise MissingDependency("opencv-python-headless", "calibration", "hand-eye calibration") from error
    lacks = [n for n in ("calibrateHandEye", "solvePnP") if not hasattr(cv2, n)]
    if lacks or not hasattr(cv2, "aruco") or not hasattr(cv2.aruco, "CharucoDetector"):
        raise ConfigError(
            f"OpenCV {cv2.__version__} lacks {', '.join(lacks) or 'the ArUco detectors'} in Python; install a 4.x from "
            "4.7 on: pip install 'opencv-python-headless>=4.7,<5'"
        )
    return cv2


@dataclass(frozen=True)
class Board:
    """What is printed.

    Raises:
        ConfigError: A size or number is out of range, or the markers do not fit.
    """

    kind: Kind = "charuco"
    columns: int = 7
    """Squares (ChArUco) or tags (grid) along x."""
    rows: int = 5
    square_m: float = 0.03
    """Side of a chessboard square (ChArUco)."""
    marker_m: float = 0.022
    """Side of a marker or tag: the black square, without its white border."""
    gap_m: float = 0.006
    """Between two tags of a grid."""
    dictionary: str = "DICT_4X4_50"
    tag_id: int = 0
    """Of a single tag; the first of a grid."""

    def __post_init__(self) -> None:
        sizes = (self.square_m, self.marker_m, self.gap_m)
        if not all(math.isfinite(s) and 0 < s < 1 for s in sizes):
            raise ConfigError(f"a board's sizes must lie in (0, 1) m, got square, marker, gap = {sizes}")
        if self.kind == "charuco" and not (self.columns >= 3 and self.rows >= 3 and self.marker_m < self.square_m):
            raise ConfigError(
                "a ChArUco board needs at least 3x3 squares and markers smaller than them, got "
                f"{self.columns}x{self.rows}, {self.marker_m * 1e3:g} mm in {self.square_m * 1e3:g} mm"
            )
        if self.kind == "apriltag_grid" and self.columns * self.rows < 2:
            raise ConfigError(f"a grid needs at least two tags, got {self.columns}x{self.rows}")
        if self.tag_id < 0:
            raise ConfigError(f"a tag's id must be at least 0, got {self.tag_id}")

    def words(self) -> str:
        """Say in words what is printed."""
        if self.kind == "charuco":
            return (
                f"ChArUco {self.columns}x{self.rows}, squares {self.square_m * 1e3:g} mm, markers "
                f"{self.marker_m * 1e3:g} mm, {self.dictionary}"
            )
        if self.kind == "apriltag":
            return f"AprilTag {self.tag_id}, {self.marker_m * 1e3:g} mm, {self.dictionary}"
        return (
            f"{self.columns}x{self.rows} AprilTags from {self.tag_id}, {self.marker_m * 1e3:g} mm, gaps "
            f"{self.gap_m * 1e3:g} mm, {self.dictionary}"
        )


@dataclass(frozen=True, eq=False)
class BoardView:
    """A board that was found in a picture."""

    T_camera_board: Float
    """(4, 4)."""
    corners_px: Float
    """(N, 2)."""
    corners_m: Float
    """(N, 3) in the board's frame."""
    reprojection_px: float
    """Root mean square distance of the corners from where the pose puts them."""


class BoardFinder:
    """Finds one board in pictures of a pinhole camera.

    Raises:
        MissingDependency: OpenCV is not installed.
        ConfigError: No such dictionary, or it has too few markers.
    """

    def __init__(self, board: Board) -> None:
        self.board = board
        self._cv = cv = opencv()
        number = getattr(cv.aruco, board.dictionary, None)
        if not board.dictionary.startswith("DICT_") or not isinstance(number, int):
            known = sorted(n for n in dir(cv.aruco) if n.startswith("DICT_"))
            raise ConfigError(f"no dictionary {board.dictionary!r}; allowed are {', '.join(known)}")
        self._dictionary = cv.aruco.getPredefinedDictionary(number)
        have = len(self._dictionary.bytesList)
        needed = {
            "charuco": board.columns * board.rows // 2,
            "apriltag": board.tag_id + 1,
            "apriltag_grid": board.tag_id + board.columns * board.rows,
        }[board.kind]
        if needed > have:
            raise ConfigError(f"{board.dictionary} has {have} markers, the board needs {needed}; choose a larger one")
        parameters = cv.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv.aruco.CORNER_REFINE_SUBPIX
        self._printed: Any = None
        if board.kind == "charuco":
            size = (board.columns, board.rows)
            self._printed = cv.aruco.CharucoBoard(size, board.square_m, board.marker_m, self._dictionary)
            self._detector = cv.aruco.CharucoDetector(self._printed, cv.aruco.CharucoParameters(), parameters)
        else:
            self._detector = cv.aruco.ArucoDetector(self._dictionary, parameters)
            if board.kind == "apriltag_grid":
                ids = board.tag_id + np.arange(board.columns * board.rows)
                size = (board.columns, board.rows)
                self._printed = cv.aruco.GridBoard(size, board.marker_m, board.gap_m, self._dictionary, ids)

    def find(self, color: NDArray[np.uint8], camera: CameraIntrinsics) -> BoardView | str:
        """Return the board's pose in a picture (H, W, 3) RGB, or why there is none."""
        grey = self._cv.cvtColor(np.ascontiguousarray(color), self._cv.COLOR_RGB2GRAY)
        found = self._corners(grey)
        if isinstance(found, str):
            return found
        corners_m, corners_px = found
        spread = np.ptp(corners_px, axis=0)
        if spread[0] * spread[1] < MIN_AREA_SHARE * camera.width * camera.height:
            return f"the board is too small in the picture ({spread[0]:.0f}x{spread[1]:.0f} px)"
        return self._pose(corners_m, corners_px, camera)

    def _corners(self, grey: NDArray[np.uint8]) -> tuple[Float, Float] | str:
        """Return corners on the board (N, 3) [m] and in the picture (N, 2) [px], or why there are none."""
        if self.board.kind == "charuco":
            corners, ids, _, marker_ids = self._detector.detectBoard(grey)
            if ids is None or len(ids) < MIN_CORNERS:
                n, m = (0 if a is None else len(a) for a in (ids, marker_ids))
                return f"{n} corners of the board are in view ({m} markers), at least {MIN_CORNERS} are needed"
            chess = np.asarray(self._printed.getChessboardCorners(), np.float64)
            return chess[np.asarray(ids).ravel()], np.asarray(corners, np.float64).reshape(-1, 2)
        corners, ids, _ = self._detector.detectMarkers(grey)
        seen = [] if ids is None else np.asarray(ids).ravel().tolist()
        if self.board.kind == "apriltag":
            if seen.count(self.board.tag_id) != 1:
                return f"tag {self.board.tag_id} is in view {seen.count(self.board.tag_id)} times, needed is once"
            half = self.board.marker_m / 2
            square = np.array([[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]])
            return square, np.asarray(corners[seen.index(self.board.tag_id)], np.float64).reshape(4, 2)
        points, pixels = self._printed.matchImagePoints(corners, ids) if seen else (None, None)
        if points is None or len(points) < MIN_CORNERS:
            return f"{0 if points is None else len(points) // 4} tags of the grid are in view, at least two are needed"
        return np.asarray(points, np.float64).reshape(-1, 3), np.asarray(pixels, np.float64).reshape(-1, 2)

    def _pose(self, corners_m: Float, corners_px: Float, camera: CameraIntrinsics) -> BoardView | str:
        cv = self._cv
        K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
        method = cv.SOLVEPNP_IPPE_SQUARE if self.board.kind == "apriltag" else cv.SOLVEPNP_IPPE
        _, turns, places, _ = cv.solvePnPGeneric(_upside(corners_m, self.board), corners_px, K, None, flags=method)
        views = [self._refined(corners_m, corners_px, K, r, t) for r, t in zip(turns, places, strict=True)]
        views = sorted((v for v in views if v.T_camera_board[2, 3] > 0), key=lambda v: v.reprojection_px)
        if not views:
            return "no pose in front of the camera fits the corners"
        best = views[0]
        if best.reprojection_px > MAX_REPROJECTION_PX:
            return f"the corners fit a pose to {best.reprojection_px:.1f} px only; is the board flat, and as described?"
        if len(views) > 1 and views[1].reprojection_px < 1.5 * best.reprojection_px + 0.05:
            a, b = (v.T_camera_board[:3, 2] for v in views[:2])
            if float(a @ b) < math.cos(math.radians(5)):
                return "the board could be tilted this way or that; come nearer, or tilt it more"
        return best

    def _refined(self, corners_m: Float, corners_px: Float, K: Float, turn: Float, place: Float) -> BoardView:
        cv = self._cv
        if self.board.kind == "apriltag":
            turn, place = _unflip(turn, place, cv)
        turn, place = cv.solvePnPRefineLM(corners_m, corners_px, K, None, turn.copy(), place.copy())
        projected, _ = cv.projectPoints(corners_m, turn, place, K, None)
        off = np.linalg.norm(projected.reshape(-1, 2) - corners_px, axis=1)
        T = make_transform(cv.Rodrigues(turn)[0], np.asarray(place, np.float64).ravel())
        return BoardView(T, corners_px, corners_m, float(np.sqrt((off**2).mean())))

    def picture(self, px_per_m: float) -> NDArray[np.uint8]:
        """Return the board as it is printed, (H, W) uint8, with a white margin of half a square or tag.

        Raises:
            ConfigError: It would be larger than 200 megapixels, or a marker smaller than 20 px.
        """
        board = self.board
        unit = board.square_m if board.kind == "charuco" else board.marker_m
        margin = round(unit / 2 * px_per_m)
        if board.kind == "charuco":
            size = (board.columns * board.square_m, board.rows * board.square_m)
        elif board.kind == "apriltag":
            size = (board.marker_m, board.marker_m)
        else:
            size = tuple(n * board.marker_m + (n - 1) * board.gap_m for n in (board.columns, board.rows))
        width, height = (round(s * px_per_m) + 2 * margin for s in size)
        if width * height > 200_000_000 or board.marker_m * px_per_m < 20:
            raise ConfigError(f"a board of {width}x{height} px cannot be drawn; choose another resolution")
        if board.kind == "apriltag":
            tag = self._cv.aruco.generateImageMarker(self._dictionary, board.tag_id, width - 2 * margin)
            return np.pad(np.asarray(tag), margin, constant_values=255)
        return np.asarray(self._printed.generateImage((width, height), marginSize=margin))


def _upside(corners_m: Float, board: Board) -> Float:
    """The square solver wants its corners with y up; the others take them as they are."""
    return corners_m * [1, -1, 1] if board.kind == "apriltag" else corners_m


def _unflip(turn: Float, place: Float, cv: Any) -> tuple[Float, Float]:
    """Turn a pose of a square with y up into one with y down: half a turn about x."""
    R = cv.Rodrigues(turn)[0] @ np.diag([1.0, -1.0, -1.0])
    return cv.Rodrigues(R)[0], place
