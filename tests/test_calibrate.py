"""`thinkgrasp calibrate`: a person moves a fake arm with a board before a fake camera; the camera file is right."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cv2", reason="needs thinkgrasp[calibration]")
pytest.importorskip("mujoco", reason="needs thinkgrasp[sim]")

from fakes.boards import CAMERA, T_BASE_BOARD, T_BASE_CAMERA, T_FLANGE_BOARD, T_FLANGE_CAMERA, photo, turns
from fakes.lab import FakeLab, cell_data
from PIL import Image

from thinkgrasp.geometry import invert, make_transform
from thinkgrasp.handeye.board import Board
from thinkgrasp.handeye.camera_file import read_pose, read_record
from thinkgrasp.motion import ur5e
from thinkgrasp.sim.world import World
from thinkgrasp.types import Frame

BOARD = Board(columns=5, rows=4, square_m=0.03, marker_m=0.022)
SIZES = ("--columns", "5", "--rows", "4")
N = 10


class Hand:
    """A person at the keyboard who moves the arm before each yes."""

    def __init__(self, lab: FakeLab, poses: list[np.ndarray]) -> None:
        self.lab, self.poses = lab, poses

    def readline(self) -> str:
        if not self.poses:
            return "n\n"
        self.lab.world.set_joints(self.poses.pop(0), 0.085)
        return "y\n"


def joints() -> list[np.ndarray]:
    """Joint angles that hold the board before the camera."""
    rng = np.random.default_rng(3)
    found = []
    for R in turns(N, rng, most_deg=30.0):
        middle = np.array([0.075, 0.06, 0.0])
        place = np.array([0.0, 0.0, 0.42]) + rng.uniform(-0.03, 0.03, 3) - R @ middle
        T_base_flange = T_BASE_CAMERA @ make_transform(R, place) @ invert(T_FLANGE_BOARD)
        q = ur5e.inverse(T_base_flange[None])[0]
        found.append(q[np.isfinite(q).all(axis=1)][0])
    return found


@pytest.fixture
def lab(monkeypatch) -> Iterator[FakeLab]:
    made = FakeLab(World([]))
    depth = np.full((CAMERA.height, CAMERA.width), 0.5, np.float32)

    def look() -> Frame:
        depth[0, 0] += 0.001  # no two depth images are the same
        T_camera_board = invert(T_BASE_CAMERA) @ ur5e.forward(made.world.joints()) @ T_FLANGE_BOARD
        return Frame(photo(BOARD, T_camera_board, seed=made.realsense.rendered), depth.copy(), CAMERA)

    made.realsense.source, made.realsense.camera = look, CAMERA
    for name, module in made.modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    yield made
    made.close()


def write_cell(folder: Path, **changes) -> Path:
    path = folder / "cell.json"
    base = [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0.02], [0, 0, 0, 1]]
    path.write_text(json.dumps(cell_data(**{"robot.T_world_base": base, **changes})))
    return path


def apart_mm(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3])) * 1e3


def test_takes_poses_solves_and_writes_the_camera_file(cli, lab, tmp_path, monkeypatch):
    cell, out = write_cell(tmp_path), tmp_path / "out"
    monkeypatch.setattr(sys, "stdin", Hand(lab, joints()))
    result = cli("calibrate", "--cell", str(cell), "--out", str(out), *SIZES)
    assert result.code == 0, result.err
    assert lab.moved == 0, "only the person moves the arm"
    assert not lab.controlled
    T_world_base = make_transform(np.eye(3), np.array([0.1, 0.0, 0.02]))
    written = read_pose(tmp_path / "camera.json", "fixed")
    assert apart_mm(written, T_world_base @ T_BASE_CAMERA) < 3.0
    record = read_record(tmp_path / "camera.json")
    assert record is not None
    assert (record.poses, record.mount) == (N, "fixed")
    assert record.held_out_mm < 2.0
    np.testing.assert_allclose(record.T_world_base, T_world_base)
    report = json.loads((out / "calibration.json").read_text())
    assert len(report["poses"]) == N
    assert f"held-out error  {record.held_out_mm:.2f} mm" in result.out
    assert result.err.count("taken: board at") == N

    # Poses that are there are not deleted by the way.
    monkeypatch.setattr(sys, "stdin", io.StringIO(""))
    refused = cli("calibrate", "--cell", str(cell), "--out", str(out), *SIZES)
    assert refused.code == 2
    assert f"holds {N} poses of an earlier calibration; solve them with --poses" in refused.err
    assert len(list(out.glob("pose_*.json"))) == N

    # The kept poses give the same answer, without robot and camera.
    monkeypatch.delitem(sys.modules, "pyrealsense2")
    (tmp_path / "camera.json").unlink()
    again = cli("calibrate", "--cell", str(cell), "--out", str(tmp_path), "--poses", str(out), *SIZES)
    assert again.code == 0, again.err
    assert apart_mm(read_pose(tmp_path / "camera.json", "fixed"), written) < 1e-6

    # What is better is not replaced without a yes.
    better = json.loads((tmp_path / "camera.json").read_text())
    better["hand_eye"]["held_out_mm"]["median"] = 0.001
    (tmp_path / "camera.json").write_text(json.dumps(better))
    for typed, code in (("", 1), ("n\n", 1), ("y\n", 0)):
        monkeypatch.setattr(sys, "stdin", io.StringIO(typed))
        again = cli("calibrate", "--cell", str(cell), "--out", str(tmp_path), "--poses", str(out), *SIZES)
        assert again.code == code, again.err
        assert "holds a calibration with an error of 0.00 mm" in again.err
        assert (json.loads((tmp_path / "camera.json").read_text()) == better) == (code == 1)

    # A board that is described with the wrong size fits nothing, and nothing is written.
    (tmp_path / "camera.json").unlink()
    sizes = (*SIZES, "--square-mm", "45", "--marker-mm", "33")
    wrong = cli("calibrate", "--cell", str(cell), "--out", str(tmp_path), "--poses", str(out), *sizes)
    assert wrong.code == 1
    assert "NOT WRITTEN: the error is above 10 mm" in wrong.err
    assert not (tmp_path / "camera.json").exists()


def test_a_camera_on_the_hand_from_kept_poses_of_an_april_grid(cli, tmp_path):
    grid = Board("apriltag_grid", 3, 2, marker_m=0.04, gap_m=0.01, dictionary="DICT_APRILTAG_36h11")
    rng = np.random.default_rng(5)
    for i, R in enumerate(turns(9, rng, most_deg=30.0)):
        T_camera_board = make_transform(R, np.array([0.0, 0.0, 0.4]) - R @ [0.07, 0.045, 0.0])
        T_base_flange = T_BASE_BOARD @ invert(T_camera_board) @ invert(T_FLANGE_CAMERA)
        pose = {"camera": asdict(CAMERA), "T_base_flange": T_base_flange.tolist()}
        (tmp_path / f"pose_{i:03d}.json").write_text(json.dumps(pose))
        Image.fromarray(photo(grid, T_camera_board, seed=i)).save(tmp_path / f"pose_{i:03d}.png")
    cell = write_cell(tmp_path, **{"camera.mount": "hand"})
    board = ("--board", "apriltag_grid", "--columns", "3", "--rows", "2", "--marker-mm", "40", "--gap-mm", "10")
    result = cli("calibrate", "--cell", str(cell), "--poses", str(tmp_path), "--out", str(tmp_path / "o"), *board)
    assert result.code == 0, result.err
    assert "in the flange frame" in result.out
    assert apart_mm(read_pose(tmp_path / "camera.json", "hand"), T_FLANGE_CAMERA) < 3.0


def test_poses_without_board_of_a_moving_arm_or_taken_twice_are_not_taken(cli, lab, tmp_path, monkeypatch):
    away, (good, other) = np.array([0.5, -1.2, 1.0, -1.0, -1.5, 0.0]), joints()[:2]
    monkeypatch.setattr(sys, "stdin", Hand(lab, [away, good, other, other]))
    look = lab.realsense.source

    def shaken() -> Frame:
        frame = look()
        if np.allclose(lab.world.joints(), good):
            lab.world.set_joints(good + 0.01, 0.085)
        return frame

    lab.realsense.source = shaken
    result = cli("calibrate", "--cell", str(write_cell(tmp_path)), "--out", str(tmp_path / "out"), *SIZES)
    assert result.code == 2
    assert "corners of the board are in view" in result.err
    assert "while the camera looked; hold it still" in result.err
    assert "not taken: the arm is where it was at pose 001" in result.err
    assert "1 usable poses are too few" in result.err


def test_draws_a_board_to_print(cli, tmp_path):
    path = tmp_path / "board.png"
    result = cli("calibrate", "--draw", str(path), *SIZES, "--dpi", "200")
    assert result.code == 0, result.err
    assert "ChArUco 5x4, squares 30 mm" in result.out
    with Image.open(path) as image:
        assert image.info["dpi"] == pytest.approx((200, 200), abs=0.1)
        assert image.width / 200 * 25.4 == pytest.approx(5 * 30 + 30, abs=0.3)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ((), "needs --cell FILE"),
        (("--draw", "board.jpg"), "must end in .png"),
        (("--draw", "board.png", "--dpi", "5"), "--dpi must lie in 50..2400"),
        (("--square-mm", "-3"), "must lie in (0, 1) m"),
        (("--cell", "none.json"), "cell file none.json is not readable"),
        (("--board", "apriltag", "--dictionary", "DICT_X", "--draw", "board.png"), "no dictionary 'DICT_X'"),
    ],
)
def test_what_cannot_be_calibrated(cli, tmp_path, monkeypatch, args, message):
    monkeypatch.chdir(tmp_path)
    result = cli("calibrate", *args)
    assert (result.code, result.out) == (2, "")
    assert message in result.err


def test_a_session_that_is_none(cli, tmp_path):
    result = cli(
        "calibrate", "--cell", str(write_cell(tmp_path)), "--poses", str(tmp_path), "--out", str(tmp_path / "o")
    )
    assert result.code == 2
    assert "holds no poses" in result.err


def test_a_cell_without_camera(cli, tmp_path):
    path = write_cell(tmp_path)
    data = json.loads(path.read_text())
    del data["camera"]
    path.write_text(json.dumps(data))
    result = cli("calibrate", "--cell", str(path), "--out", str(tmp_path / "o"))
    assert result.code == 2
    assert "lacks the entry camera" in result.err
