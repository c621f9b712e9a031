"""What failed before is found again by place, not by name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from fakes.stages import FakeScene, table_frame

from thinkgrasp.memory import Attempt, Memory
from thinkgrasp.types import Grasp, Outcome

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
