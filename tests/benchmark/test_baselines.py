from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from fakes.stages import fake_pipeline, table_frame

from thinkgrasp.benchmark.baselines import BestScore, Forgetful, PlannedMark, RandomObject, WithoutGraph
from thinkgrasp.memory import Attempt, Memory
from thinkgrasp.testing.scenes import empty_scene, sample_scene
from thinkgrasp.types import Grasps, Obstruction, Outcome, Plan, Scene


def test_a_random_object_is_any_of_them_and_the_same_for_the_same_seed():
    scene = sample_scene()
    marks = [RandomObject(seed=seed).plan(scene, "the red box", Memory()).mark for seed in range(100)]
    assert set(marks) == {p.mark for p in scene.proposals}
    assert max(Counter(marks).values()) < 50
    assert [RandomObject(seed=seed).plan(scene, "a cup", Memory()).mark for seed in range(100)] == marks


def test_a_random_object_is_none_without_a_grasp():
    scene = sample_scene()
    first, *rest = scene.proposals
    memory = Memory()
    for p in rest:
        memory = memory.remember(Attempt("x", 5, None, np.asarray(p.center_m), Outcome(False, "no_grasp")))
    assert {RandomObject(seed=seed).plan(scene, "x", memory).mark for seed in range(20)} == {first.mark}
    assert not RandomObject().plan(empty_scene(), "x", Memory()).found


def test_the_planned_mark_is_segmented_alone():
    scene = sample_scene()
    (segment,) = PlannedMark().segment(scene, Plan("thing", "", mark=scene.proposals[1].mark)).segments
    assert segment.mark == scene.proposals[1].mark
    assert segment.mask is scene.proposals[1].mask
    assert PlannedMark().segment(scene, Plan("thing", "")).segments == ()


class _Generator:
    """One grasp on each half of the table; the one on the right scores more."""

    def generate(self, scene, crop, gripper, rng) -> Grasps:
        points = scene.points[24, [16, 48]]
        assert crop[24, 16]
        assert crop[24, 48]
        rotations = np.broadcast_to(np.eye(3, dtype=np.float32), (2, 3, 3)).copy()
        return Grasps(rotations, points, np.full(2, 0.05, np.float32), np.array([0.4, 0.9], np.float32))


def test_the_best_score_wins_wherever_it_is_and_is_called_by_its_mark():
    pipeline = BestScore.of(fake_pipeline(generator=_Generator()))
    decision = pipeline.decide(table_frame(), "the red one")
    assert decision.grasp is not None
    assert decision.grasp.score == pytest.approx(0.9)
    assert decision.target is not None
    assert (decision.target.mark, decision.plan.mark) == (2, 2)
    assert decision.target.box_xyxy == (40, 16, 56, 32)
    assert BestScore.of(fake_pipeline()).decide(table_frame(things=False), "it").status == "no_target"


def test_the_forgetful_repeat_what_failed():
    frame = table_frame()
    plain = fake_pipeline()
    first = plain.decide(frame, "red")
    assert first.grasp is not None
    memory = Memory().remember(
        Attempt("red", 5, first.grasp, np.asarray(first.scene.proposals[0].center_m), Outcome(False, "slipped"))
    )
    second, forgot = plain.decide(frame, "red", memory), Forgetful.of(plain).decide(frame, "red", memory)
    assert second.grasp is not None
    assert forgot.grasp is not None
    assert np.array_equal(forgot.grasp.position, first.grasp.position)
    assert not np.array_equal(second.grasp.position, first.grasp.position)


def test_without_a_graph_all_else_is_there():
    scene = replace(sample_scene(), obstructions=(Obstruction("hides", 1, 2, 10.0, "px"),))

    class Perception:
        def perceive(self, frame) -> Scene:
            return scene

    found = WithoutGraph(Perception()).perceive(scene.frame)
    assert found.obstructions == ()
    assert found.proposals == scene.proposals
