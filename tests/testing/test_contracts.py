"""The contract checks pass good plug-ins and name the rule that a broken one breaks."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from fakes.stages import FakeCheck, FakeGenerator, FakePlanner, FakeScene, FakeSegmenter, table_frame

from thinkgrasp import testing
from thinkgrasp.errors import ConfigError, ContractError, InputError
from thinkgrasp.testing.scenes import sample_frame, sample_scene
from thinkgrasp.types import Degradation, Frame, Grasps, Obstruction, Outcome, Plan, PlannedObject, Scene


class GoodCamera:
    def read(self):
        return table_frame()


class GoodRobot:
    def execute(self, grasp, frame):
        return Outcome(True, "held")


class GoodRecorder:
    def record(self, decision, outcome):
        return None


@pytest.mark.parametrize(
    ("check", "plugin"),
    [
        (testing.check_scene, FakeScene()),
        (testing.check_planner, FakePlanner()),
        (testing.check_segmenter, FakeSegmenter()),
        (testing.check_generator, FakeGenerator()),
        (testing.check_check, FakeCheck()),
        (testing.check_camera, GoodCamera()),
        (testing.check_robot, GoodRobot()),
        (testing.check_recorder, GoodRecorder()),
    ],
)
def test_good_plugins_pass(check, plugin):
    check(plugin)


ALL_CHECKS = [getattr(testing, name) for name in testing.__all__ if name.startswith("check_")]


@pytest.mark.parametrize("check", ALL_CHECKS)
def test_an_object_without_the_method_is_named(check):
    with pytest.raises(ContractError, match="object lacks the method"):
        check(object())


def altered(base: type, method: str, change):
    """A stage whose method's result goes through `change(result, *arguments)`."""

    class Altered(base):
        pass

    def call(self, *arguments):
        return change(getattr(base, method)(self, *arguments), *arguments)

    setattr(Altered, method, call)
    return Altered()


def with_first_proposal(**changes):
    def change(scene: Scene, frame: Frame):
        if not scene.proposals:
            return scene
        return replace(scene, proposals=(replace(scene.proposals[0], **changes), *scene.proposals[1:]))

    return change


def fill_depth(scene: Scene, frame: Frame):
    frame.depth[:] = 1
    return scene


def flipped(T):
    T = T.copy()
    T[:3, 0] *= -1
    return T


class Forgetful(FakeScene):
    """Gives another answer every time."""

    def __init__(self):
        self.calls = 0

    def perceive(self, frame):
        self.calls += 1
        scene = super().perceive(frame)
        return replace(scene, region=np.full(frame.depth.shape, self.calls % 2 == 0))


@pytest.mark.parametrize(
    ("plugin", "message"),
    [
        (altered(FakeScene, "perceive", lambda s, f: None), "must return Scene, got NoneType"),
        (altered(FakeScene, "perceive", lambda s, f: replace(s, frame=table_frame())), "the frame that was given"),
        (altered(FakeScene, "perceive", lambda s, f: replace(s, points=s.points.astype(float))), "Scene.points must"),
        (altered(FakeScene, "perceive", lambda s, f: replace(s, normals=2 * np.ones_like(s.points))), "unit or NaN"),
        (altered(FakeScene, "perceive", with_first_proposal(mark=7)), "marks must be 1..n"),
        (altered(FakeScene, "perceive", with_first_proposal(box_xyxy=(0, 0, 5, 5))), "half-open box"),
        (altered(FakeScene, "perceive", with_first_proposal(mask=np.zeros((240, 320), bool))), "must not be empty"),
        (altered(FakeScene, "perceive", with_first_proposal(extents_m=(0.1, 0.2, 0.1))), "longest side first"),
        (altered(FakeScene, "perceive", with_first_proposal(extents_m=(0.1, 0.1, 0.0))), "must be positive"),
        (altered(FakeScene, "perceive", with_first_proposal(T_camera_object=flipped(np.eye(4)))), "proper rotations"),
        (altered(FakeScene, "perceive", with_first_proposal(colors=(("red", 1.5),))), "must be in 0..1"),
        (altered(FakeScene, "perceive", with_first_proposal(confidence=80.0)), "confidence must be in 0..1"),
        (
            altered(
                FakeScene, "perceive", lambda s, f: replace(s, obstructions=(Obstruction("hides", 1, 99, 1.0, "px"),))
            ),
            "must join two marks",
        ),
        (Forgetful(), "another result the second time"),
    ],
)
def test_broken_scenes(plugin, message):
    with pytest.raises(ContractError, match=message):
        testing.check_scene(plugin)


def plan_with(**changes):
    return altered(FakePlanner, "plan", lambda plan, *_: replace(plan, **changes))


class Raising:
    def plan(self, scene, instruction, memory):
        raise InputError("I see nothing")


class Moody(FakePlanner):
    def __init__(self):
        super().__init__()
        self.rng = np.random.default_rng()

    def plan(self, scene, instruction, memory):
        return Plan("x", f"because {self.rng.random()}")


@pytest.mark.parametrize(
    ("plugin", "message"),
    [
        (altered(FakePlanner, "plan", lambda plan, *_: "the red box"), "must return Plan, got str"),
        (plan_with(mark=99), "mark 99 is not in this scene"),
        (plan_with(role="boss"), "role must be one of"),
        (plan_with(kind="thing"), "kind must be one of"),
        (plan_with(rationale=" "), "rationale must say why"),
        (plan_with(found=True, target=""), "target must name"),
        (plan_with(crop_xyxy=(0, 0, 5000, 5)), "is not inside 320x240"),
        (plan_with(objects=(PlannedObject("box", 101.0),)), "grasp_score must be in 0..100"),
        (plan_with(objects=(PlannedObject("box", 50.0, 10),)), "cell must be in 1..9"),
        (plan_with(degraded=(Degradation("plan", "", "offline"),)), "must name stage, reason and fallback"),
        (Raising(), "raised InputError: I see nothing"),
        (Moody(), "another result the second time"),
    ],
)
def test_broken_planners(plugin, message):
    with pytest.raises(ContractError, match=message):
        testing.check_planner(plugin)


def test_a_planner_may_be_declared_not_deterministic():
    testing.check_planner(Moody(), deterministic=False)


def segments_with(**changes):
    return altered(
        FakeSegmenter, "segment", lambda s, *_: replace(s, segments=tuple(replace(x, **changes) for x in s.segments))
    )


def worst_first(segmentation, *_):
    segments = tuple(replace(s, score=score) for s in segmentation.segments for score in (0.1, 0.9))
    return replace(segmentation, segments=segments)


@pytest.mark.parametrize(
    ("plugin", "message"),
    [
        (altered(FakeSegmenter, "segment", lambda s, *_: list(s.segments)), "must return Segmentation, got list"),
        (segments_with(mask=np.ones((2, 2), bool)), r"Segment.mask must be \(240, 320\) bool"),
        (segments_with(mask=np.ones((240, 320), np.uint8)), "Segment.mask must be"),
        (segments_with(box_xyxy=(0, 0, 1, 1)), "half-open box"),
        (segments_with(score=float("nan")), "score must be finite"),
        (segments_with(label=""), "label must not be empty"),
        (segments_with(mark=50), "mark 50 is not in this scene"),
        (altered(FakeSegmenter, "segment", worst_first), "best first"),
    ],
)
def test_broken_segmenters(plugin, message):
    with pytest.raises(ContractError, match=message):
        testing.check_segmenter(plugin)


def grasps_with(change):
    return altered(FakeGenerator, "generate", lambda g, *_: change(g) if len(g) else g)


class IgnoresCrop(FakeGenerator):
    def generate(self, scene, crop, gripper, rng):
        return super().generate(scene, np.ones_like(crop), gripper, rng)


class OwnRandomness(FakeGenerator):
    def generate(self, scene, crop, gripper, rng):
        return super().generate(scene, crop, gripper, np.random.default_rng())


class CropWriter(FakeGenerator):
    def generate(self, scene, crop, gripper, rng):
        grasps = super().generate(scene, crop, gripper, rng)
        crop[0, 0] = ~crop[0, 0]
        return grasps


@pytest.mark.parametrize(
    ("plugin", "message"),
    [
        (grasps_with(lambda g: list(g)), "must return Grasps, got list"),
        (grasps_with(lambda g: replace(g, rotations=-g.rotations)), "proper rotations"),
        (grasps_with(lambda g: replace(g, rotations=2 * g.rotations)), "proper rotations"),
        (grasps_with(lambda g: replace(g, scores=g.scores + 1)), "scores must be in 0..1"),
        (grasps_with(lambda g: replace(g, widths=-g.widths)), "widths must be in 0..1"),
        (grasps_with(lambda g: replace(g, positions=g.positions * np.float32(np.nan))), "positions must be finite"),
        (grasps_with(lambda g: replace(g, positions=g.positions + 1)), "camera frame, on the crop"),
        (IgnoresCrop(), "nothing can be grasped|on the crop"),
        (OwnRandomness(), "another result the second time"),
    ],
)
def test_broken_generators(plugin, message):
    with pytest.raises(ContractError, match=message):
        testing.check_generator(plugin)


@pytest.mark.parametrize(
    ("check", "plugin"),
    [
        (testing.check_scene, altered(FakeScene, "perceive", fill_depth)),
        (testing.check_generator, CropWriter()),
    ],
)
def test_inputs_must_not_be_changed_and_are_as_before(check, plugin):
    depth, mask = sample_frame().depth.copy(), sample_scene().proposals[0].mask.copy()
    with pytest.raises(ContractError, match=r"input array .* was changed"):
        check(plugin)
    assert np.array_equal(sample_frame().depth, depth)
    assert np.array_equal(sample_scene().proposals[0].mask, mask)


class FailsOnNone:
    def keep(self, scene, target, grasps, gripper):
        return grasps.scores >= grasps.scores.max()


@pytest.mark.parametrize(
    ("plugin", "message"),
    [
        (altered(FakeCheck, "keep", lambda k, *_: k.astype(np.uint8)), "must be .* bool, got"),
        (altered(FakeCheck, "keep", lambda k, *_: np.nonzero(k)[0]), "the result must be"),
        (altered(FakeCheck, "keep", lambda k, *_: k.tolist()), "must return ndarray, got list"),
        (FailsOnNone(), re.escape("0 grasps) raised ValueError")),
    ],
)
def test_broken_checks(plugin, message):
    with pytest.raises(ContractError, match=message):
        testing.check_check(plugin)


def test_broken_devices():
    class BlindCamera:
        def read(self):
            frame = table_frame()
            return replace(frame, depth=np.zeros_like(frame.depth))

    class MuteRobot:
        def execute(self, grasp, frame):
            return Outcome(False, "")

    class FullRecorder:
        def record(self, decision, outcome):
            raise OSError("disk full")

    for check, plugin, message in (
        (testing.check_camera, BlindCamera(), "no return at all"),
        (testing.check_robot, MuteRobot(), "reason must name"),
        (testing.check_recorder, FullRecorder(), "raised OSError: disk full"),
    ):
        with pytest.raises(ContractError, match=message):
            check(plugin)


class ScriptedRobot:
    """Answers with what a function of the grasp's distance and the frame says."""

    def __init__(self, answer):
        self.answer = answer

    def execute(self, grasp, frame):
        return self.answer(float(np.linalg.norm(grasp.position)), frame)


def needs_pose(distance, frame):
    if frame.T_world_camera is None:
        raise InputError("where is the camera?")
    return Outcome(False, "unreachable")


def fails_far_away(distance, frame):
    if distance > 3:
        raise ValueError("no solution")
    return Outcome(True, "held")


def fails_without_pose(distance, frame):
    return Outcome(True, "held") if frame.T_world_camera.shape == (4, 4) else None


def test_robots_may_ask_for_the_cameras_pose():
    testing.check_robot(ScriptedRobot(needs_pose))


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (fails_far_away, r"5 m away\) raised ValueError: no solution"),
        (fails_without_pose, "without camera pose.* raised AttributeError"),
        (lambda *_: None, "must return Outcome, got NoneType"),
        (lambda *_: Outcome(True, "missed"), "success is told as 'held'"),
        (lambda *_: Outcome(False, "held"), "success is told as 'held'"),
        (lambda *_: Outcome(False, "It slipped."), "reason must name"),
        (lambda *_: Outcome(1, "held"), "success must be bool, got int"),
    ],
)
def test_broken_robots(answer, message):
    with pytest.raises(ContractError, match=message):
        testing.check_robot(ScriptedRobot(answer))


class NeedsPose(FakeCheck):
    def keep(self, scene, target, grasps, gripper):
        if scene.frame.T_world_camera is None:
            raise ConfigError("where is the camera?")
        return super().keep(scene, target, grasps, gripper)


def test_checks_may_ask_for_the_cameras_pose():
    testing.check_check(NeedsPose())


def test_checks_may_not_stumble_over_a_missing_pose():
    class Stumbles(FakeCheck):
        def keep(self, scene, target, grasps, gripper):
            return super().keep(scene, target, grasps, gripper) & (scene.frame.T_world_camera[0, 0] < 2)

    with pytest.raises(ContractError, match=r"without camera pose.* raised TypeError"):
        testing.check_check(Stumbles())


def test_samples_are_what_they_say():
    full = testing.sample_scene()
    assert len(full.proposals) == 10
    assert full.support is not None
    heights = full.support.height(full.points)
    assert abs(float(np.median(heights[full.support.inliers]))) < 0.003
    assert all(p.height_m[1] > 0.01 for p in full.proposals)
    assert not testing.empty_scene().proposals
    assert testing.strict_scene().support is None
    assert isinstance(Grasps.empty(), Grasps)
