"""Collecting poses for a calibration: a person moves the arm and holds it still, we look and read the joints.

Nothing here moves the arm. Each pose is kept as a picture and a JSON file, so that a session can be solved again.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from thinkgrasp.errors import InputError
from thinkgrasp.handeye.board import BoardFinder, BoardView
from thinkgrasp.handeye.solve import MIN_POSES, HandEye, Sample, repeats
from thinkgrasp.interfaces import Camera
from thinkgrasp.lab.person import Person
from thinkgrasp.outputs import make_folder, write_atomic
from thinkgrasp.types import CameraIntrinsics

Float = NDArray[np.float64]

STILL_M, STILL_RAD = 0.0005, 0.002
"""By how much the flange may move while the camera looks."""
GOOD_POSES = 15


def collect(
    camera: Camera, flange: Callable[[], Float], finder: BoardFinder, person: Person, folder: Path
) -> tuple[list[Sample], CameraIntrinsics]:
    """Take poses until the person says that there are enough.

    Args:
        camera: Looks at the board.
        flange: Returns T_base_flange (4, 4) now.
        finder: Of the board.
        person: Moves the arm and is asked for each pose.
        folder: Where poses are kept; those that are there are replaced if the person agrees.

    Raises:
        InputError: The camera fails, the folder cannot be written, or holds poses that are not to be replaced.
    """
    make_folder(folder)
    _make_room(folder, person)
    samples: list[Sample] = []
    intrinsics: CameraIntrinsics | None = None
    person.tell(
        "Move the arm by hand (freedrive), turn the wrist about different axes, hold still. At least "
        f"{MIN_POSES} poses, better {GOOD_POSES}; answer no when done."
    )
    while person.confirms(f"{len(samples)} poses taken. Take one more?"):
        before = flange()
        frame = camera.read()
        after = flange()
        intrinsics = frame.camera
        moved = _motion(before, after)
        if moved:
            person.tell(f"not taken: {moved}")
            continue
        seen = finder.find(frame.color, frame.camera)
        if isinstance(seen, str):
            person.tell(f"not taken: {seen}")
            continue
        if before_it := repeats(samples, after):
            person.tell(f"not taken: the arm is where it was at pose {before_it}; turn and move it")
            continue
        name = f"{len(samples) + 1:03d}"
        _keep(folder, name, frame.color, frame.camera, after, seen)
        samples.append(Sample(after, seen.T_camera_board, name))
        distance = float(np.linalg.norm(seen.T_camera_board[:3, 3]))
        person.tell(f"taken: board at {distance:.2f} m, {len(seen.corners_px)} corners, {seen.reprojection_px:.2f} px")
    if intrinsics is None:
        raise InputError("no pose was taken")
    return samples, intrinsics


def _make_room(folder: Path, person: Person) -> None:
    old = [*folder.glob("pose_*.png"), *folder.glob("pose_*.json")]
    if not old:
        return
    poses = len({path.stem for path in old})
    if not person.confirms(f"{folder} holds {poses} poses of an earlier calibration. Delete them?"):
        raise InputError(
            f"{folder} holds {poses} poses of an earlier calibration; solve them with --poses, or give --out"
        )
    try:
        for path in old:
            path.unlink()
    except OSError as error:
        raise InputError(f"the poses in {folder} cannot be deleted: {error.strerror or error}") from error


def read_session(folder: Path, finder: BoardFinder) -> tuple[list[Sample], CameraIntrinsics, list[str]]:
    """Find the board in the pictures of a session again.

    Returns:
        Usable poses, the camera's intrinsics, and a line for each pose that cannot be used.

    Raises:
        InputError: The folder holds no session, or a file cannot be read.
    """
    paths = sorted(folder.glob("pose_*.json"))
    if not paths:
        raise InputError(f"{folder} holds no poses (pose_001.json with pose_001.png, ...) of a calibration")
    samples: list[Sample] = []
    refused: list[str] = []
    intrinsics: CameraIntrinsics | None = None
    for path in paths:
        name = path.stem.removeprefix("pose_")
        camera, T_base_flange, color = _read_pose(path)
        if intrinsics is not None and camera != intrinsics:
            raise InputError(f"{path}: the camera's intrinsics are not those of the poses before")
        intrinsics = camera
        seen = finder.find(color, camera)
        if isinstance(seen, str):
            refused.append(f"pose {name} is not used: {seen}")
        else:
            samples.append(Sample(T_base_flange, seen.T_camera_board, name))
    assert intrinsics is not None  # there is at least one path
    return samples, intrinsics, refused


def report_lines(result: HandEye) -> list[str]:
    """Say how good a calibration is."""
    mm, deg = result.held_out_mm, result.held_out_deg
    worst = int(np.argmax(mm))
    lines = [
        f"{len(mm)} poses, solver {result.solver}",
        f"held-out error (each pose predicted from the others): median {np.median(mm):.2f} mm and "
        f"{np.median(deg):.3f} deg, "
        f"largest {mm.max():.2f} mm (pose {result.names[worst]}) and {deg.max():.3f} deg",
        f"fitted error: median {result.fitted_mm:.2f} mm (always smaller; no measure of accuracy)",
    ]
    if result.outliers:
        lines.append(
            f"poses that do not fit the others: {', '.join(result.outliers)}; did the board slip? take them again"
        )
    return lines


def _motion(before: Float, after: Float) -> str:
    moved = float(np.linalg.norm(after[:3, 3] - before[:3, 3]))
    turned = float(np.arccos(np.clip((np.trace(before[:3, :3].T @ after[:3, :3]) - 1) / 2, -1, 1)))
    if moved <= STILL_M and turned <= STILL_RAD:
        return ""
    return (
        f"the arm moved by {moved * 1e3:.1f} mm and {np.degrees(turned):.2f} deg while the camera looked; hold it still"
    )


def _keep(
    folder: Path, name: str, color: NDArray[np.uint8], camera: CameraIntrinsics, T_base_flange: Float, seen: BoardView
) -> None:
    data: dict[str, Any] = {
        "camera": asdict(camera),
        "T_base_flange": T_base_flange.tolist(),
        "T_camera_board": seen.T_camera_board.tolist(),
        "reprojection_px": round(seen.reprojection_px, 4),
    }
    try:
        Image.fromarray(color).save(folder / f"pose_{name}.png")
    except OSError as error:
        raise InputError(f"pose {name} cannot be kept in {folder}: {error.strerror or error}") from error
    write_atomic(folder / f"pose_{name}.json", (json.dumps(data, indent=2) + "\n").encode())


def _read_pose(path: Path) -> tuple[CameraIntrinsics, Float, NDArray[np.uint8]]:
    from thinkgrasp.cameras.files import read_color

    try:
        data: Any = json.loads(path.read_text(encoding="utf-8"))
        camera = CameraIntrinsics(**data["camera"])
        T = np.array(data["T_base_flange"], np.float64)
    except (OSError, UnicodeDecodeError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path} is no pose of a calibration: {error!r}") from error
    R = T[:3, :3] if T.shape == (4, 4) else np.zeros((3, 3))
    if not (np.isfinite(T).all() and np.allclose(R @ R.T, np.eye(3), atol=1e-3) and np.linalg.det(R) > 0):
        raise InputError(f"{path}: T_base_flange must be 4 rows of 4 finite numbers, a rigid transform")
    color = read_color(path.with_suffix(".png"))
    if color.shape[:2] != (camera.height, camera.width):
        raise InputError(f"{path.with_suffix('.png')} is not of the camera's size, {camera.width}x{camera.height}")
    return camera, T, color
