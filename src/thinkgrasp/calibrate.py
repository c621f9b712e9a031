"""A calibration from start to end: take or read poses, solve, say how good it is, write the camera file."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import cast

import numpy as np
from PIL import Image

from thinkgrasp import registry
from thinkgrasp.errors import ConfigError
from thinkgrasp.handeye.board import Board, BoardFinder
from thinkgrasp.handeye.camera_file import has_pose, read_record, write_camera_file
from thinkgrasp.handeye.session import collect, read_session, report_lines
from thinkgrasp.handeye.solve import HandEye, solve
from thinkgrasp.interfaces import Camera
from thinkgrasp.lab.agreement import HELD_OUT_DEG, HELD_OUT_MM
from thinkgrasp.lab.cell import load_cell
from thinkgrasp.lab.person import Person
from thinkgrasp.outputs import write_atomic

REPORT_FILE = "calibration.json"


@dataclass(frozen=True)
class CalibrateOptions:
    """What to calibrate with what."""

    cell: Path
    board: Board = field(default_factory=Board)
    poses: Path | None = None
    """Folder of a session to solve again; None = take new poses."""
    camera: str = "realsense"
    camera_settings: Mapping[str, object] = field(default_factory=dict[str, object])


def run_calibration(
    options: CalibrateOptions, person: Person, out: Path, tell: Callable[[str], None]
) -> tuple[HandEye, Path | None]:
    """Find where the cell's camera is.

    Returns:
        The result, and the camera file that was written; None where the error is too large to work with, or the
        person keeps what the file holds, which is better.

    Raises:
        ConfigError: Cell, robot or camera cannot be used.
        InputError: The poses do not determine the camera's place, or a file cannot be read or written.
        MissingDependency: OpenCV or a driver is not installed.
    """
    cell = load_cell(options.cell)
    if cell.camera is None:
        raise ConfigError(f"cell file {options.cell} lacks the entry camera, with mount and file")
    finder = BoardFinder(options.board)
    if options.poses is not None:
        samples, intrinsics, refused = read_session(options.poses, finder)
        for line in refused:
            tell(line)
    else:
        from thinkgrasp.motion import ur5e
        from thinkgrasp.robots.ur_link import Halted, URLink

        with ExitStack() as stack:
            settings = {**cell.camera.settings, **options.camera_settings}
            camera = cast(Camera, registry.load("camera", options.camera, **settings))
            stack.callback(getattr(camera, "close", lambda: None))
            link = URLink(cell.robot.host, control=False)
            stack.callback(link.close)
            try:
                samples, intrinsics = collect(camera, lambda: ur5e.forward(link.fresh().q), finder, person, out)
            except Halted as halt:
                raise ConfigError(f"the poses cannot be taken: {halt.detail}") from halt
    result = solve(samples, cell.camera.mount)
    for line in report_lines(result):
        tell(line)
    report = {
        "board": options.board.words(),
        "mount": result.mount,
        "solver": result.solver,
        "T_camera": result.T_camera.tolist(),
        "T_board": result.T_board.tolist(),
        "poses": [
            {"name": name, "held_out_mm": round(float(mm), 3), "held_out_deg": round(float(deg), 4)}
            for name, mm, deg in zip(result.names, result.held_out_mm, result.held_out_deg, strict=True)
        ],
    }
    write_atomic(out / REPORT_FILE, (json.dumps(report, indent=2) + "\n").encode())
    if not (result.median_mm <= HELD_OUT_MM and result.median_deg <= HELD_OUT_DEG):
        tell(
            f"NOT WRITTEN: the error is above {HELD_OUT_MM:g} mm or {HELD_OUT_DEG:g} deg. Are the board's sizes right "
            "(measure them), is it flat and fixed, did arm and board stand still?"
        )
        return result, None
    path = options.cell.parent / cell.camera.file
    if not _may_replace(path, result, person):
        tell(f"NOT WRITTEN: {path} keeps the calibration that it holds")
        return result, None
    write_camera_file(path, intrinsics, result, options.board, cell.mount.T_world_base)
    return result, path


def _may_replace(path: Path, result: HandEye, person: Person) -> bool:
    """Whether a camera file may take this result: asked where what it holds is better, or not known to be worse."""
    if not path.exists():
        return True
    record = read_record(path)
    if record is None:
        return not has_pose(path) or person.confirms(f"{path} holds a pose of unknown error. Replace it?")
    if round(result.median_mm, 3) <= record.held_out_mm and round(result.median_deg, 4) <= record.held_out_deg:
        return True
    return person.confirms(
        f"{path} holds a calibration with an error of {record.held_out_mm:.2f} mm and {record.held_out_deg:.3f} deg; "
        f"this one has {result.median_mm:.2f} mm and {result.median_deg:.3f} deg. Replace it?"
    )


def draw_board(board: Board, path: Path, dpi: int) -> tuple[float, float]:
    """Write a board as a picture to print at its true size; return width and height [m] with the margin.

    Raises:
        ConfigError: The board cannot be drawn.
        InputError: The file cannot be written.
        MissingDependency: OpenCV is not installed.
    """
    import io

    if not 50 <= dpi <= 2400:
        raise ConfigError(f"--dpi must lie in 50..2400, got {dpi}")
    picture = BoardFinder(board).picture(dpi / 0.0254)
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(picture)).save(buffer, "PNG", dpi=(dpi, dpi))
    write_atomic(path, buffer.getvalue())
    return picture.shape[1] * 0.0254 / dpi, picture.shape[0] * 0.0254 / dpi
