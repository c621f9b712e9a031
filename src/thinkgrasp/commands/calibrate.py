"""`thinkgrasp calibrate`: where the camera of a cell is, from a board and poses of the arm."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import UseAppendAction, arg

from thinkgrasp.commands.terminal import DONE, NOTHING, progress
from thinkgrasp.errors import ConfigError
from thinkgrasp.outputs import check_writable, make_folder

DEFAULT_DICTIONARIES = {
    "charuco": "DICT_4X4_50",
    "apriltag": "DICT_APRILTAG_36h11",
    "apriltag_grid": "DICT_APRILTAG_36h11",
}


@dataclass(frozen=True)
class CalibrateCommand:
    """Find where the camera is: a board, some poses of the arm (moved by hand), and an error that was not fitted to."""

    cell: Annotated[Path | None, arg(metavar="FILE")] = None
    """The cell; its entry camera says what carries the camera and which camera file is written."""
    poses: Annotated[Path | None, arg(metavar="DIR")] = None
    """Solve the poses of an earlier session again, without robot and camera."""
    camera: Annotated[str, arg(metavar="NAME")] = "realsense"
    """Camera plug-in."""
    camera_set: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="KEY=VALUE")] = ()
    """One setting of the camera plug-in, over those of the cell file."""
    board: Literal["charuco", "apriltag", "apriltag_grid"] = "charuco"
    """What is printed: a ChArUco board, one AprilTag, or a grid of them."""
    columns: Annotated[int, arg(metavar="N")] = 7
    """Squares or tags along x."""
    rows: Annotated[int, arg(metavar="N")] = 5
    """Squares or tags along y."""
    square_mm: Annotated[float, arg(metavar="MM")] = 30.0
    """Side of a chessboard square, measured on the print."""
    marker_mm: Annotated[float, arg(metavar="MM")] = 22.0
    """Side of a marker or tag (the black square), measured on the print."""
    gap_mm: Annotated[float, arg(metavar="MM")] = 6.0
    """Between two tags of a grid."""
    dictionary: Annotated[str | None, arg(metavar="NAME")] = None
    """OpenCV's name of the markers' dictionary; default DICT_4X4_50, for AprilTags DICT_APRILTAG_36h11."""
    tag_id: Annotated[int, arg(metavar="N")] = 0
    """Id of a single tag, or of a grid's first."""
    draw: Annotated[Path | None, arg(metavar="PNG")] = None
    """Only write a picture of the board, to print at its true size."""
    dpi: Annotated[int, arg(metavar="DPI")] = 300
    """Resolution of that picture."""
    out: Path = Path("out/calibration")
    """Folder for the poses and calibration.json."""
    debug: bool = False
    """Show the traceback of an error."""

    def run(self) -> int:
        """Carry the command out and return the exit code."""
        from thinkgrasp.calibrate import CalibrateOptions, draw_board, run_calibration
        from thinkgrasp.config import parse_assignment
        from thinkgrasp.handeye.board import Board
        from thinkgrasp.lab.person import AtTheKeyboard

        board = Board(
            kind=self.board,
            columns=self.columns,
            rows=self.rows,
            square_m=self.square_mm / 1e3,
            marker_m=self.marker_mm / 1e3,
            gap_m=self.gap_mm / 1e3,
            dictionary=self.dictionary or DEFAULT_DICTIONARIES[self.board],
            tag_id=self.tag_id,
        )
        if self.draw is not None:
            if self.draw.suffix.lower() != ".png":
                raise ConfigError(f"--draw {self.draw} must end in .png")
            check_writable(self.draw, "--draw")
            width, height = draw_board(board, self.draw, self.dpi)
            print(f"{self.draw}: {board.words()}")
            print(
                f"  print at 100 %: {width * 1e3:.1f} x {height * 1e3:.1f} mm with its margin; measure a "
                "marker afterwards"
            )
            return DONE
        if self.cell is None:
            raise ConfigError(
                "thinkgrasp calibrate needs --cell FILE (or --draw PNG); docs/real_robot.md says what is in it"
            )
        make_folder(self.out)
        options = CalibrateOptions(
            self.cell,
            board,
            self.poses,
            self.camera,
            dict(parse_assignment(text, "--camera-set") for text in self.camera_set),
        )
        result, written = run_calibration(options, AtTheKeyboard(), self.out, progress)
        place = ", ".join(f"{c:.4f}" for c in result.T_camera[:3, 3])
        frame = "base" if result.mount == "fixed" else "flange"
        print(f"camera at ({place}) m in the {frame} frame; {board.words()}")
        print(
            f"  held-out error  {result.median_mm:.2f} mm, {result.median_deg:.3f} deg (median of "
            f"{len(result.names)} poses)"
        )
        print(f"  camera file     {written if written is not None else 'NOT WRITTEN'}")
        return DONE if written is not None else NOTHING
