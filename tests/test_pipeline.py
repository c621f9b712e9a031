"""The order of the stages, the outcomes that are values, and the contracts that are enforced."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fakes.stages import (
    FakeCheck,
    FakeGenerator,
    FakePlanner,
    FakeSegmenter,
    box_of,
    fake_pipeline,
    table_frame,
)

from thinkgrasp.errors import ContractError, InputError
from thinkgrasp.pipeline import MAX_INSTRUCTION_CHARS
from thinkgrasp.types import Degradation, Grasps, Plan, Segment, Segmentation

TIMINGS = ["scene", "plan", "segment", "generate", "check", "select", "total"]


def test_a_grasp(pipeline, frame):
    decision = pipeline.decide(frame, "the red block")
    assert decision.status == "grasp"
    assert decision.target is not None
    assert decision.target.mark == 1
    assert decision.grasp is not None
    u, v = frame.camera.project(decision.grasp.position)
    assert decision.target.mask[round(v), round(u)]
    assert len(decision.alternatives) == 9
    scores = [decision.grasp.score, *(g.score for g in decision.alternatives)]
    assert scores == sorted(scores, reverse=True)
    assert [name for name, _ in decision.timings_ms] == TIMINGS
    candidates, step = decision.funnel
    assert (candidates.check, candidates.n_in, candidates.n_out) == ("candidates", 20, 20)
    assert (step.check, step.n_in) == ("score", 20)
    assert step.n_out < 20


def test_same_input_same_decision(pipeline, frame):
    a, b = (pipeline.decide(frame, "the blue block") for _ in range(2))
    assert np.array_equal(a.grasp.position, b.grasp.position)
    assert a.funnel == b.funnel


def test_the_seed_matters(frame):
    a, b = (fake_pipeline(seed=s).decide(frame, "red") for s in (0, 1))
    assert not np.array_equal(a.grasp.position, b.grasp.position)


@pytest.mark.parametrize("n", [1, 4])
def test_n_nearest_limits_the_choice(frame, n):
    assert len(fake_pipeline(n_nearest=n).decide(frame, "red").alternatives) == n - 1


@pytest.mark.parametrize("cell", range(1, 10))
def test_the_cell_moves_the_preferred_point(frame, cell):
    decision = fake_pipeline(planner=FakePlanner(cell=cell)).decide(frame, "red")
    x0, y0, x1, y1 = decision.target.box_xyxy
    u, v = frame.camera.project(decision.preferred_point)
    row, column = divmod(cell - 1, 3)
    assert x0 + column * (x1 - x0) / 3 - 1 <= u <= x0 + (column + 1) * (x1 - x0) / 3
    assert y0 + row * (y1 - y0) / 3 - 1 <= v <= y0 + (row + 1) * (y1 - y0) / 3


class TestNothingToTake:
    def test_planner_found_nothing(self, pipeline, frame):
        decision = pipeline.decide(frame, "the green block")
        assert (decision.status, decision.target, decision.grasp, decision.funnel) == ("no_target", None, None, ())
        assert [name for name, _ in decision.timings_ms] == ["scene", "plan", "total"]

    def test_bare_table(self, pipeline):
        assert pipeline.decide(table_frame(things=False), "red").status == "no_target"

    def test_segmenter_found_nothing(self, frame):
        class Blind:
            def segment(self, scene, plan):
                return Segmentation((), (Degradation("segment", "blind", "nothing"),))

        decision = fake_pipeline(segmenter=Blind()).decide(frame, "red")
        assert decision.status == "no_target"
        assert decision.degraded[0].reason == "blind"

    def test_generator_found_nothing(self, frame):
        decision = fake_pipeline(generator=FakeGenerator(0)).decide(frame, "red")
        assert (decision.status, decision.grasp) == ("no_grasp", None)
        assert decision.preferred_point is not None

    def test_checks_removed_all(self, frame):
        decision = fake_pipeline(checks={"a": FakeCheck(0.0), "b": FakeCheck(2.0), "c": FakeCheck()}).decide(
            frame, "red"
        )
        assert decision.status == "no_grasp"
        assert [(s.check, s.n_in, s.n_out) for s in decision.funnel[1:]] == [("a", 20, 20), ("b", 20, 0), ("c", 0, 0)]


def test_the_next_match_is_taken_when_the_best_cannot_be_grasped(frame):
    class Both:
        def segment(self, scene, plan):
            return Segmentation(
                tuple(Segment(f"thing {p.mark}", 1 / p.mark, p.mask, p.box_xyxy, False) for p in scene.proposals)
            )

    class OnlySecond:
        def keep(self, scene, target, grasps, gripper):
            return np.full(len(grasps), target.label == "thing 2")

    decision = fake_pipeline(segmenter=Both(), checks={"second": OnlySecond()}).decide(frame, "red")
    assert decision.status == "grasp"
    assert decision.target.label == "thing 2"
    (fallback,) = decision.degraded
    assert (fallback.stage, fallback.fallback) == ("select", "the next match (thing 2)")
    assert decision.crop is not None
    assert box_of(decision.crop) == (8, 16, 56, 32)


def test_strict_mode_runs_without_a_scene_stage(frame):
    class ByText:
        def segment(self, scene, plan):
            assert scene.proposals == ()
            assert scene.support is None
            mask = scene.frame.color[..., 0] > 190
            return Segmentation((Segment(plan.target, 1.0, mask, box_of(mask), False),))

    class Names:
        def plan(self, scene, instruction, memory):
            return Plan(instruction, "said so")

    decision = fake_pipeline(scene=None, planner=Names(), segmenter=ByText()).decide(frame, "red block")
    assert decision.status == "grasp"


class TestBadInput:
    @pytest.mark.parametrize("instruction", ["", "   ", "\n\t"])
    def test_empty_instruction(self, pipeline, frame, instruction):
        with pytest.raises(InputError, match="the instruction is empty"):
            pipeline.decide(frame, instruction)

    def test_endless_instruction(self, pipeline, frame):
        with pytest.raises(InputError, match=f"10000 characters; at most {MAX_INSTRUCTION_CHARS}"):
            pipeline.decide(frame, "x" * 10_000)

    def test_surrounding_space_is_dropped(self, pipeline, frame):
        assert pipeline.decide(frame, "  red ").instruction == "red"

    @pytest.mark.parametrize("value", [0, np.nan])
    def test_no_depth(self, pipeline, frame, value):
        with pytest.raises(InputError, match="no return at all"):
            pipeline.decide(replace(frame, depth=np.full_like(frame.depth, value)), "red")


class TestBrokenStages:
    def test_check_of_the_wrong_length(self, frame):
        class Short:
            def keep(self, scene, target, grasps, gripper):
                return np.ones(3, bool)

        with pytest.raises(ContractError, match=r"check 'short' must return \(20,\) bool, got \(3,\) bool"):
            fake_pipeline(checks={"short": Short()}).decide(frame, "red")

    def test_check_of_the_wrong_type(self, frame):
        class Indices:
            def keep(self, scene, target, grasps, gripper):
                return np.arange(len(grasps))

        with pytest.raises(ContractError, match="int64"):
            fake_pipeline(checks={"i": Indices()}).decide(frame, "red")

    @pytest.mark.parametrize("mask", [np.zeros((48, 64), bool), np.ones((2, 2), bool), np.ones((48, 64), np.uint8)])
    def test_segments_that_are_no_masks(self, frame, mask):
        class Wrong(FakeSegmenter):
            def segment(self, scene, plan):
                (segment,) = super().segment(scene, plan).segments
                return Segmentation((replace(segment, mask=mask),))

        with pytest.raises(ContractError, match="segment 'red' must be a non-empty"):
            fake_pipeline(segmenter=Wrong()).decide(frame, "red")


def test_the_generator_sees_the_union_of_the_masks_and_the_gripper(frame):
    seen = {}

    class Spy(FakeGenerator):
        def generate(self, scene, crop, gripper, rng):
            seen.update(crop=crop.copy(), gripper=gripper)
            return Grasps.empty()

    pipeline = fake_pipeline(generator=Spy())
    decision = pipeline.decide(frame, "red")
    assert np.array_equal(seen["crop"], decision.target.mask)
    assert seen["gripper"] is pipeline.gripper
