"""The rules as pure functions: each with what it must let through, and what it must not."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
from fakes.lab import make_cell
from hypothesis import given, settings
from hypothesis import strategies as st

from thinkgrasp.lab.safety import (
    HALTS,
    Reason,
    check_motion,
    joint_speed,
    pose_from_ur,
    presses_too_hard,
    safety_refusal,
    slowed_to,
    tip_speed,
)
from thinkgrasp.motion.cell import HOME_RAD
from thinkgrasp.motion.trajectory import PERIOD_S, Trajectory, time_path

CELL = make_cell(**{"limits.joint_speed_rad_s": 0.5, "limits.tcp_speed_m_s": 0.3})
HOME = np.array(HOME_RAD)


def turned(*by: float) -> np.ndarray:
    """Home with its joints turned by so much."""
    return HOME + np.array(by)


THERE = turned(-0.6, 0.0, 0.3, -0.2, 0.0, 0.4)


def run(path: np.ndarray, steps: int) -> Trajectory:
    """Samples along a polyline, PERIOD_S apart, at constant speed."""
    at = np.linspace(0, len(path) - 1, steps + 1)
    q = np.stack([np.interp(at, np.arange(len(path)), joint) for joint in path.T], axis=1)
    return Trajectory(np.arange(steps + 1) * PERIOD_S, q)


SLOW = time_path(np.array([HOME, THERE]), CELL.joint_limits, speed=0.5)
MIDDLE = len(SLOW.positions) // 2


def test_a_good_motion_is_let_through():
    assert check_motion(SLOW, HOME, CELL, tcp_speed_m_s=0.3) is None


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("where", [(0, 0), (MIDDLE, 3), (-1, 5)])
def test_one_number_that_is_none_stops_a_whole_motion(value, where):
    q = SLOW.positions.copy()
    q[where] = value
    refusal = check_motion(Trajectory(SLOW.times_s, q), HOME, CELL, tcp_speed_m_s=0.3)
    assert refusal is not None
    assert refusal.reason == "invalid_pose"


def test_a_motion_that_starts_elsewhere_is_a_jump():
    refusal = check_motion(SLOW, turned(0, 0, 0, 0, 0, 0.03), CELL, tcp_speed_m_s=0.3)
    assert refusal is not None
    assert refusal.reason == "jump"
    unknown = check_motion(SLOW, np.full(6, np.nan), CELL, tcp_speed_m_s=0.3)
    assert unknown is not None
    assert unknown.reason == "jump"


@pytest.mark.parametrize(
    ("goal", "word"),
    [
        (turned(0.0, 1.2, 0, 0, 0, 0), "fingertips"),
        (turned(1.8, 0, 0, 0, 0, 0), "would be at"),
        (turned(0.0, -0.9, 0.0, 0.0, 0, 0), "would be at"),
        (turned(0, 0, 2.0, 0, 0, 0), "leaves the joints' ranges"),
    ],
)
def test_a_motion_out_of_the_box_is_refused(goal, word):
    refusal = check_motion(run(np.array([HOME, goal]), 4000), HOME, CELL, tcp_speed_m_s=1.0)
    assert refusal is not None
    assert refusal.reason == "outside_workspace"
    assert word in refusal.detail


def test_an_excursion_in_the_middle_is_seen():
    out = turned(0.0, 1.2, 0, 0, 0, 0)
    refusal = check_motion(run(np.array([HOME, out, HOME]), 8000), HOME, CELL, tcp_speed_m_s=1.0)
    assert refusal is not None
    assert refusal.reason == "outside_workspace"


def test_a_jerk_in_the_middle_is_too_fast():
    """Forth and back again in an instant, each at a speed that is allowed."""
    q = SLOW.positions.copy()
    q[MIDDLE] = q[MIDDLE - 1]
    refusal = check_motion(Trajectory(SLOW.times_s, q), HOME, CELL, tcp_speed_m_s=0.3)
    assert refusal is not None
    assert "speed up or brake" in refusal.detail
    assert check_motion(run(np.array([HOME, THERE]), 1000), HOME, CELL, tcp_speed_m_s=0.3) is not None, "no ramp"


def test_too_fast_for_a_joint_or_for_the_fingertips():
    fast = run(np.array([HOME, THERE]), 200)
    refusal = check_motion(fast, HOME, CELL, tcp_speed_m_s=10.0)
    assert refusal is not None
    assert (refusal.reason, "a joint would turn" in refusal.detail) == ("too_fast", True)
    refusal = check_motion(SLOW, HOME, CELL, tcp_speed_m_s=0.02)
    assert refusal is not None
    assert (refusal.reason, "the fingertips would move" in refusal.detail) == ("too_fast", True)


@settings(max_examples=12)
@given(st.integers(0, 2**16), st.floats(0.02, 1.0))
def test_slowing_down_makes_any_motion_pass_the_check_on_the_same_path(seed, tcp_speed):
    over = turned(*np.random.default_rng(seed).uniform(-0.2, 0.2, 6))
    fast = time_path(np.array([HOME, over, THERE]), CELL.joint_limits)
    slow = slowed_to(fast, CELL, tcp_speed_m_s=tcp_speed)
    assert joint_speed(slow.positions) <= CELL.limits.joint_speed_rad_s * 1.0001
    assert tip_speed(slow.positions, CELL) <= tcp_speed * 1.01
    np.testing.assert_array_equal(slow.positions[[0, -1]], fast.positions[[0, -1]])
    refusal = check_motion(slow, HOME, CELL, tcp_speed_m_s=tcp_speed)
    assert refusal is None, refusal


def test_slow_motions_stay_as_they_are():
    planned = time_path(np.array([HOME, THERE]), CELL.joint_limits)
    assert joint_speed(planned.positions) <= CELL.limits.joint_speed_rad_s * 1.001
    assert slowed_to(planned, CELL, tcp_speed_m_s=5.0) is planned


@pytest.mark.parametrize(
    ("bits", "mode", "reason"),
    [
        (0b1, 7, None),
        (0b10, 7, None),
        (0b1, 5, "robot_not_ready"),
        (0b1, 3, "robot_not_ready"),
        (0, 7, "safety_fault"),
        (1 << 2, 7, "protective_stop"),
        (1 << 2 | 1, 7, "protective_stop"),
        (1 << 3, 7, "safety_fault"),
        (1 << 4, 7, "safeguard_stop"),
        (1 << 5, 7, "emergency_stop"),
        (1 << 6, 7, "emergency_stop"),
        (1 << 7, 7, "emergency_stop"),
        (1 << 7 | 1 << 10, 7, "emergency_stop"),
        (1 << 2 | 1 << 10, 7, "protective_stop"),
        (1 << 8, 7, "safety_fault"),
        (1 << 9, 7, "safety_fault"),
        (1 << 10 | 1, 7, "safety_fault"),
    ],
)
def test_safety_bits(bits, mode, reason):
    refusal = safety_refusal(bits, mode)
    assert (refusal.reason if refusal else None) == reason


@given(st.integers(0, 2**11 - 1))
def test_only_normal_and_reduced_mode_may_move(bits):
    assert (safety_refusal(bits, 7) is None) == (bits in (0b01, 0b10, 0b11))


def test_forces():
    zero = np.zeros(6)
    assert not presses_too_hard(np.array([30.0, 0, 39, 9, 9, 9]), zero, 50.0)
    assert presses_too_hard(np.array([31.0, 0, 40, 0, 0, 0]), zero, 50.0)
    assert not presses_too_hard(np.array([0, 0, -70.0, 0, 0, 0]), np.array([0, 0, -40.0, 0, 0, 0]), 50.0)
    assert presses_too_hard(np.full(6, np.nan), zero, 50.0), "a force that is none is too much"


def test_the_controllers_poses():
    T = pose_from_ur(np.array([0.1, 0.2, 0.3, 0.0, 0.0, np.pi / 2]))
    np.testing.assert_allclose(T @ [1, 0, 0, 1], [0.1, 1.2, 0.3, 1], atol=1e-12)


def test_reasons_are_names():
    reasons = set(get_args(Reason))
    assert reasons >= HALTS
    assert all(r.isidentifier() and r.islower() for r in reasons)
    assert "held" not in reasons
    assert not HALTS & {"refused_by_person", "unreachable", "missed", "slipped", "collision", "dry_run"}
