"""What the benchmark of several views concludes: which answers it counts, and which grasp it takes for real."""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")

from fakes.stages import fake_pipeline, table_frame
from fakes.table_loop import POSE

from thinkgrasp.types import Grasp

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    return importlib.import_module("multi_view")


def test_the_table_counts_what_the_first_view_shows(bench):
    answers = [
        bench.Answer("p", thing, how, found, real, 100.0)
        for thing, how, found, real in [
            (0, "first", True, False), (0, "fused", True, True), (0, "other", False, False),
            (1, "first", False, False), (1, "fused", True, True), (1, "other", True, False),
            (2, "first", False, False), (2, "fused", False, False),
            (3, "other", True, True),
        ]
    ]  # fmt: skip
    said = bench.report(answers)
    assert said.startswith("3 things that the first view shows")
    assert "| first | 1 | 0 | 100 |" in said
    assert "| fused | 2 | 2 | 100 |" in said
    assert "| other | 1 | 0 | 100 |" in said, "what only the other view shows does not count"
    assert "2 of them have no grasp on the first view" in said
    for row in (
        "| fused | 1 | 1 |",
        "| other | 1 | 0 |",
        "| fused, then other | 1 | 1 |",
        "| other, then fused | 1 | 0 |",
    ):
        assert row in said


def test_a_grasp_is_real_when_it_meets_nothing_and_has_the_thing_between_its_fingers(bench):
    """A post 2 cm thick, thing 0, and a wall, thing 1, in a world that is the camera's turned over."""
    z = np.arange(0.0, 0.1, 0.002)
    post = np.array([[x, y, h] for x in (-0.01, 0.01) for y in (-0.005, 0.0, 0.005) for h in z])
    wall = np.array([[0.2, y, h] for y in np.arange(-0.05, 0.05, 0.002) for h in z])
    truth = bench.Truth(np.concatenate([post, wall]), np.repeat([0, 1], [len(post), len(wall)]).astype(np.int32))
    frame = table_frame(T_world_camera=POSE)

    def grasp(x: float, width_m: float) -> Grasp:
        return Grasp(np.eye(3), np.array([x, 0.0, -0.06]), width_m, 1.0)

    pipeline = fake_pipeline()
    assert truth.is_real(grasp(0.0, 0.05), frame, 0, pipeline)
    assert not truth.is_real(grasp(0.0, 0.05), frame, 1, pipeline), "another thing is between the fingers"
    assert not truth.is_real(grasp(0.0, 0.018), frame, 0, pipeline), "a finger would come down on it"
    assert not truth.is_real(grasp(0.17, 0.05), frame, 1, pipeline), "a finger in the wall"
    assert not truth.is_real(grasp(-0.2, 0.05), frame, 0, pipeline), "nothing is there"
