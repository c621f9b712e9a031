"""Cell files: what is read, and one clear line for everything that cannot be worked with."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from fakes.lab import cell_data, make_cell

from thinkgrasp.errors import ConfigError
from thinkgrasp.lab.cell import load_cell
from thinkgrasp.motion import ur5e
from thinkgrasp.motion.cell import BIN, HOME_RAD, STATICS
from thinkgrasp.motion.robotiq_2f85 import tip_reach

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "cell.json"


def write(folder: Path, data: object) -> Path:
    path = folder / "cell.json"
    path.write_text(json.dumps(data))
    return path


def test_the_example_is_a_cell():
    cell = load_cell(EXAMPLE)
    assert cell.camera is not None
    assert cell.fingertips(cell.home)[2, 3] > 0.2


def test_the_simulated_cell_as_a_file_is_the_simulated_cell(tmp_path):
    cell = load_cell(write(tmp_path, cell_data()))
    assert cell.statics[1:5] == BIN.walls
    assert {b.name for b in cell.statics} == {b.name for b in STATICS}
    assert cell.bin_box == BIN
    np.testing.assert_allclose(cell.fingertips(np.array(HOME_RAD))[:3, 3], [0.252, 0.499, 0.456], atol=1e-3)
    assert cell.joint_limits.velocity.max() == 2.0


def test_a_coupling_and_a_turned_base_move_the_fingertips():
    turned = [[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.05], [0, 0, 0, 1]]
    cell = make_cell(**{
        "robot.T_world_base": turned, "robot.gripper.coupling_m": 0.014, "robot.gripper.yaw_rad": 0.5,
        "workspace_m": [[-2, -2, -1], [2, 2, 2]],
    })  # fmt: skip
    q = np.array(HOME_RAD)
    flange = ur5e.forward(q)
    tip = flange[:3, 3] + flange[:3, 2] * (0.014 + float(tip_reach(0.0)))
    expected = np.array(turned)[:3, :3] @ tip + [0.1, 0.2, 0.05]
    np.testing.assert_allclose(cell.fingertips(q)[:3, 3], expected, atol=1e-12)
    assert cell.T_flange_tcp[2, 3] == pytest.approx(0.014 + float(tip_reach(0.0)))


def test_speeds_are_cut_to_a_share_and_never_raised():
    cell = make_cell()
    half = cell.slowed(0.5)
    assert half.limits.joint_speed_rad_s == cell.limits.joint_speed_rad_s / 2
    assert half.limits.tcp_speed_m_s == cell.limits.tcp_speed_m_s / 2
    assert half.robot.gripper.speed_m_s == cell.robot.gripper.speed_m_s / 2
    assert half.limits.force_n == cell.limits.force_n
    for share in (1.01, 0.0, -1.0, float("nan")):
        with pytest.raises(ConfigError, match="limits are raised in the cell file only"):
            cell.slowed(share)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("robot.host", "", "robot.host: String should have at least 1 character"),
        ("robot.model", "ur10e", "robot.model: Input should be 'ur5e'"),
        ("robot.home_rad", [0, 0, 0], "robot.home_rad"),
        ("robot.home_rad", [0, float("nan"), 0, 0, 0, 0], "robot.home_rad.1: Input should be a finite number"),
        ("robot.home_rad", [9, 0, 0, 0, 0, 0], "robot.home_rad is outside of the joints' ranges"),
        ("robot.home_rad", [0, 0, 0, 0, 0, 0], "at robot.home_rad the fingertips are at"),
        ("workspace_m", [[0.0, -0.42, -0.005], [0.95, 0.78, 0.5]], "at robot.home_rad the flange is at"),
        ("robot.T_world_base", np.diag([1.0, -1, -1, 1]).tolist(), "T_world_base may turn about z only"),
        ("robot.T_world_base", (2 * np.eye(4)).tolist(), "T_world_base must be a finite 4x4"),
        ("robot.T_world_base", np.eye(3).tolist(), "robot.T_world_base"),
        ("robot.speed", 3, "robot.speed: Extra inputs are not permitted"),
        ("robot.gripper.port", 0, "robot.gripper.port"),
        ("robot.gripper.model", "robotiq_2f140", "motions can be planned for the robotiq_2f85 only"),
        ("robot.gripper.force_n", 500, "robot.gripper.force_n: Input should be less than or equal to 235"),
        ("robot.gripper.coupling_m", -0.01, "robot.gripper.coupling_m"),
        ("limits.joint_speed_rad_s", 4.0, "limits.joint_speed_rad_s: Input should be less than or equal to 2.1"),
        ("limits.tcp_speed_m_s", 1.5, "limits.tcp_speed_m_s: Input should be less than or equal to 1"),
        ("limits.approach_speed_m_s", 0.5, "limits.approach_speed_m_s"),
        ("limits.tcp_speed_m_s", True, "limits.tcp_speed_m_s: Input should be a valid number"),
        ("limits.tcp_speed_m_s", "0.2", "limits.tcp_speed_m_s: Input should be a valid number"),
        ("grasping_m", [[0.3, -0.4, 0.0], [0.8, 0.4, True]], "grasping_m.1.2: Input should be a valid number"),
        ("limits.force_n", 500, "limits.force_n: Input should be less than or equal to 150"),
        ("limits.force_n", 0, "limits.force_n"),
        ("workspace_m", [[1, 1, 1], [0, 0, 0]], "workspace_m must be two corners, the lowest first"),
        ("workspace_m", [[0.2, -0.4, 0], [0.8, 0.4, 0.9]], "must lie within workspace_m"),
        ("grasping_m", [[0.2, -0.4, 0], [5, 0.4, 0.3]], "grasping_m must lie within workspace_m"),
        ("bin.x_m", [0.6, 0.2], "bin.x_m must be two numbers, the lowest first"),
        ("bin.x_m", [3.0, 3.4], "over the middle of the bin"),
        ("table.x_m", [1, 0], "table.x_m must be two numbers"),
        ("obstacles", [{"name": "table", "center_m": [0, 0, 0], "size_m": [1, 1, 1]}], "names of their own"),
        ("obstacles", [{"name": "x y", "center_m": [0, 0, 0], "size_m": [1, 1, 1]}], "obstacles.0.name"),
        ("obstacles", [{"name": "box", "center_m": [0, 0, 0], "size_m": [0, 1, 1]}], "obstacles.0.size_m.0"),
        ("camera.mount", "ceiling", "camera.mount: Input should be 'fixed' or 'hand'"),
    ],
)
def test_what_cannot_be_worked_with_is_named(tmp_path, key, value, message):
    path = write(tmp_path, cell_data(**{key: value}))
    with pytest.raises(ConfigError) as caught:
        load_cell(path)
    assert str(path) in str(caught.value)
    assert message in str(caught.value)
    assert len(str(caught.value)) < 600


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not readable JSON"),
        ("[]", '"schema": "thinkgrasp/cell-1"'),
        ('{"schema": "thinkgrasp/cell-2"}', '"schema": "thinkgrasp/cell-1"'),
        ('{"schema": "thinkgrasp/cell-1"}', "robot: Field required"),
    ],
)
def test_files_that_are_none(tmp_path, text, message):
    path = tmp_path / "cell.json"
    path.write_text(text)
    with pytest.raises(ConfigError, match="cell file") as caught:
        load_cell(path)
    assert message in str(caught.value)


def test_no_file(tmp_path):
    with pytest.raises(ConfigError, match="not readable JSON"):
        load_cell(tmp_path / "none.json")
