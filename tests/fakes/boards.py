"""Poses of an arm that carries a board or a camera, and pictures of boards as a pinhole camera sees them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from thinkgrasp.geometry import invert, make_transform
from thinkgrasp.handeye.board import Board, BoardFinder
from thinkgrasp.handeye.solve import Mount, Sample
from thinkgrasp.sim.views import look_at
from thinkgrasp.types import CameraIntrinsics

CAMERA = CameraIntrinsics(640, 480, 600.0, 600.0, 319.5, 239.5)
T_BASE_CAMERA = look_at((0.86, 0.05, 0.55), (0.50, 0.0, 0.02))
T_FLANGE_CAMERA = make_transform(
    Rotation.from_euler("xyz", [8, -12, 95], degrees=True).as_matrix(), [0.03, -0.07, 0.05]
)
T_FLANGE_BOARD = make_transform(
    Rotation.from_euler("xyz", [183, -5, 20], degrees=True).as_matrix(), [0.01, -0.02, 0.06]
)
T_BASE_BOARD = make_transform(Rotation.from_euler("xyz", [180, 0, 30], degrees=True).as_matrix(), [0.5, 0.05, 0.0])


def turns(n: int, rng: np.random.Generator, axes: str = "xyz", most_deg: float = 35.0) -> list[np.ndarray]:
    """Rotations about some of the axes, spread up to an angle."""
    found = []
    for _ in range(n):
        angles = {axis: rng.uniform(-most_deg, most_deg) if axis in axes else 0.0 for axis in "xyz"}
        found.append(Rotation.from_euler("xyz", [angles[a] for a in "xyz"], degrees=True).as_matrix())
    return found


def samples(
    mount: Mount,
    n: int = 15,
    *,
    seed: int = 0,
    noise_mm: float = 0.0,
    noise_deg: float = 0.0,
    axes: str = "xyz",
    most_deg: float = 35.0,
) -> list[Sample]:
    """Poses around one from which the board faces the camera; noise is on the board's pose."""
    rng = np.random.default_rng(seed)
    X = T_BASE_CAMERA if mount == "fixed" else T_FLANGE_CAMERA
    Z = T_FLANGE_BOARD if mount == "fixed" else T_BASE_BOARD
    made = []
    for i, R in enumerate(turns(n, rng, axes, most_deg)):
        place = np.array([0.0, 0.0, 0.5]) + rng.uniform(-0.06, 0.06, 3)
        T_camera_board = make_transform(R, place)
        flange = {"fixed": X @ T_camera_board @ invert(Z), "hand": Z @ invert(T_camera_board) @ invert(X)}
        off = Rotation.from_rotvec(np.radians(noise_deg) * rng.normal(size=3)).as_matrix()
        seen = T_camera_board @ make_transform(off, np.zeros(3))
        seen[:3, 3] += noise_mm * 1e-3 * rng.normal(size=3)
        made.append(Sample(flange[mount], seen, f"{i + 1:03d}"))
    return made


def photo(
    board: Board, T_camera_board: np.ndarray, camera: CameraIntrinsics = CAMERA, *, noise: float = 2.0, seed: int = 0
) -> np.ndarray:
    """The printed board in front of grey, (H, W, 3) uint8, anti-aliased by drawing larger."""
    import cv2

    px_per_m, more = 8000.0, 3
    finder = BoardFinder(board)
    flat = finder.picture(px_per_m)
    unit = board.square_m if board.kind == "charuco" else board.marker_m
    margin = round(unit / 2 * px_per_m)
    # Pixels of the print to metres on the board; a single tag has its origin in its middle.
    half = board.marker_m / 2 if board.kind == "apriltag" else 0.0
    to_board = np.array(
        [
            [1 / px_per_m, 0, (0.5 - margin) / px_per_m - half],
            [0, 1 / px_per_m, (0.5 - margin) / px_per_m - half],
            [0, 0, 1],
        ]
    )
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    onto = K @ np.column_stack([T_camera_board[:3, 0], T_camera_board[:3, 1], T_camera_board[:3, 3]])
    larger = np.array([[more, 0, (more - 1) / 2], [0, more, (more - 1) / 2], [0, 0, 1.0]])
    H = larger @ onto @ to_board
    size = (camera.width * more, camera.height * more)
    canvas = np.full((size[1], size[0]), 120, np.uint8)
    drawn = cv2.warpPerspective(flat, H, size, dst=canvas, flags=cv2.INTER_AREA, borderMode=cv2.BORDER_TRANSPARENT)
    small = cv2.resize(drawn, (camera.width, camera.height), interpolation=cv2.INTER_AREA).astype(np.float64)
    small += np.random.default_rng(seed).normal(0, noise, small.shape)
    return np.repeat(np.clip(small, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
