"""What failed before is found again by place, not by name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fakes.stages import FakeScene, table_frame
from scipy.spatial.transform import Rotation

from thinkgrasp.memory import Attempt, Memory
from thinkgrasp.types import Grasp, Grasps, Outcome

PROPOSAL = FakeScene().perceive(table_frame()).proposals[0]
GRASP = Grasp(np.eye(3), np.zeros(3), 0.05, 0.9)


def attempt(offset_m: float = 0.0, success: bool = False) -> Attempt:
    center = PROPOSAL.center_m + np.array([offset_m, 0, 0])
    return Attempt("red block", 5, GRASP, center, Outcome(success, "held" if success else "missed"))


def test_remembering_leaves_the_old_memory_alone():
    empty = Memory()
    one = empty.remember(attempt())
    two = one.remember(attempt(0.5))
    assert (len(empty.attempts), len(one.attempts), len(two.attempts)) == (0, 1, 2)
    assert two.attempts[0] is one.attempts[0]


def test_only_failures_nearby_count():
    memory = Memory((attempt(), attempt(0.029), attempt(0.031), attempt(success=True)))
    assert memory.failures_at(PROPOSAL) == memory.attempts[:2]
    assert memory.failures_at(PROPOSAL, radius_m=0.05) == memory.attempts[:3]


def test_another_place_has_no_failures():
    T = PROPOSAL.T_camera_object.copy()
    T[:3, 3] += 1
    assert Memory((attempt(),)).failures_at(replace(PROPOSAL, T_camera_object=T)) == ()


def seen_at(x: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x
    return T


def test_memory_travels_to_another_camera():
    here, there = seen_at(0.0), seen_at(0.1)
    memory = Memory().seen_from(here).remember(attempt()).seen_from(there)
    moved = memory.attempts[0]
    assert moved.object_center == pytest.approx(PROPOSAL.center_m - [0.1, 0, 0])
    assert moved.grasp is not None
    assert moved.grasp.position == pytest.approx([-0.1, 0, 0])
    back = memory.seen_from(here)
    assert back.failures_at(PROPOSAL) == back.attempts
    assert memory.seen_from(there) is memory


def test_a_thing_is_worn_out_after_three_failures_until_something_else_is_gone():
    memory = Memory((attempt(), attempt()))
    assert not memory.is_worn_out(PROPOSAL)
    memory = memory.remember(attempt())
    assert memory.is_worn_out(PROPOSAL)
    memory = memory.remember(attempt(0.5, success=True))
    assert not memory.is_worn_out(PROPOSAL)
    assert memory.remember(attempt()).is_worn_out(PROPOSAL)


def test_a_thing_without_a_grasp_is_worn_out_at_once():
    assert Memory((replace(attempt(), grasp=None),)).is_worn_out(PROPOSAL)


@pytest.mark.parametrize(
    ("turn_deg", "shift_m", "axis", "same"),
    [(0, 0, "z", True), (180, 0, "z", True), (15, 0.01, "z", True), (30, 0, "z", False), (30, 0, "x", False),
     (0, 0.02, "z", False)],
)  # fmt: skip
def test_a_failed_grasp_is_recognised_either_way_round(turn_deg: float, shift_m: float, axis: str, same: bool):
    R = Rotation.from_euler(axis, turn_deg, degrees=True).as_matrix()
    grasps = Grasps(
        R[None].astype(np.float32), np.array([[shift_m, 0, 0]], np.float32), np.array([0.05], np.float32),
        np.array([0.9], np.float32),
    )  # fmt: skip
    assert Memory((attempt(),)).repeats(grasps).tolist() == [same]
    assert Memory((attempt(success=True),)).repeats(grasps).tolist() == [False]
