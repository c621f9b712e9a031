"""Findings from what is measured, and how many of them it takes to move."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs thinkgrasp[sim]")
pytest.importorskip("trimesh", reason="needs thinkgrasp[sim]")

from fakes.cell import VIEW, look
from fakes.lab import make_cell

from thinkgrasp.geometry import make_transform
from thinkgrasp.lab.agreement import (
    CalibrationRecord,
    Finding,
    arm_finding,
    enough,
    kinematics_finding,
    record_finding,
    table_finding,
    tool_finding,
)
from thinkgrasp.motion import ur5e
from thinkgrasp.motion.cell import HOME_RAD
from thinkgrasp.motion.collision import PlanningWorld
from thinkgrasp.sim.world import World

CELL = make_cell()
HOME = np.array(HOME_RAD)
IN_VIEW = np.array([-3.41, -1.29, 2.0, -2.3, -1.57, -1.84])
TCP = ur5e.forward(HOME) @ CELL.T_flange_tcp


def shift(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    return make_transform(np.eye(3), np.array([x, y, z]))


def test_the_tool():
    assert tool_finding(HOME, TCP, CELL).state == "ok"
    assert tool_finding(HOME, TCP @ shift(z=0.007), CELL).state == "ok"
    wrong = tool_finding(HOME, TCP @ shift(z=0.009), CELL)
    assert wrong.state == "failed"
    assert "9.0 mm and 0.0 deg apart" in wrong.detail
    c, s = np.cos(0.06), np.sin(0.06)
    tilt = make_transform(np.array([[1, 0, 0], [0, c, -s], [0, s, c]]), np.zeros(3))
    assert tool_finding(HOME, TCP @ tilt, CELL).state == "failed"
    turn = make_transform(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.zeros(3))
    assert tool_finding(HOME, TCP @ turn, CELL).state == "ok", "URCaps turn the TCP about z as they like"


def test_another_arm_is_noticed():
    assert kinematics_finding(HOME, TCP, CELL.T_flange_tcp).state == "ok"
    assert kinematics_finding(HOME, TCP @ shift(x=0.05), CELL.T_flange_tcp).state == "failed"
    assert kinematics_finding(HOME, TCP, None).state == "open"


@pytest.mark.parametrize(
    ("record", "state"),
    [
        (None, "open"),
        (CalibrationRecord("fixed", np.eye(4), 2.0, 0.2, 15), "ok"),
        (CalibrationRecord("fixed", shift(y=0.004), 2.0, 0.2, 15), "failed"),
        (CalibrationRecord("fixed", np.eye(4), 2.0, 2.0, 15), "failed"),
        (CalibrationRecord("hand", np.eye(4), 2.0, 0.2, 15), "failed"),
        (CalibrationRecord("fixed", np.eye(4), float("nan"), 0.2, 15), "failed"),
    ],
)
def test_the_record(record, state):
    assert record_finding(record, CELL).state == state


def test_the_table():
    frame = look(World([]))
    assert table_finding(frame, CELL).state == "ok"
    assert table_finding(replace(frame, T_world_camera=shift(z=0.010) @ VIEW.T_world_camera), CELL).state == "ok"
    for z in (0.015, -0.015):
        moved = replace(frame, T_world_camera=shift(z=z) @ VIEW.T_world_camera)
        assert table_finding(moved, CELL).state == "failed"
    nothing = replace(frame, depth=np.zeros_like(frame.depth))
    assert table_finding(nothing, CELL).state == "open"
    assert table_finding(replace(frame, T_world_camera=None), CELL).state == "failed"


def test_the_arm_in_view():
    world = World([])
    world.set_joints(IN_VIEW, 0.085)
    frame, model = look(world), PlanningWorld()
    assert arm_finding(frame, IN_VIEW, 0.085, model).state == "ok"
    assert arm_finding(frame, IN_VIEW + 0.15, 0.085, model).state == "failed"
    for moved in (shift(x=0.08), shift(y=0.10)):
        wrong = replace(frame, T_world_camera=moved @ VIEW.T_world_camera)
        assert arm_finding(wrong, IN_VIEW, 0.085, model).state == "failed"
    away = replace(frame, T_world_camera=shift(x=3.0) @ VIEW.T_world_camera)
    assert arm_finding(away, IN_VIEW, 0.085, model).state == "open"


@pytest.mark.parametrize(
    ("states", "moves"),
    [
        ({"tool": "ok", "table": "ok", "arm in view": "ok"}, True),
        ({"tool": "ok", "table": "ok", "arm in view": "open", "calibration record": "open"}, True),
        ({"tool": "ok", "table": "open", "arm in view": "open", "calibration record": "ok"}, False),
        ({"tool": "failed", "table": "ok", "arm in view": "ok"}, False),
        ({"tool": "ok", "table": "failed", "arm in view": "ok"}, False),
        ({}, False),
    ],
)
def test_something_seen_has_to_confirm_and_nothing_may_fail(states, moves):
    assert enough([Finding(name, state, "") for name, state in states.items()]) is moves
