"""Observe, decide, execute, verify, remember: every way an episode can go on and end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fakes.stages import FakeCheck, FakePlanner, fake_pipeline
from fakes.table_loop import POSE, FakeCamera, FakeRecorder, FakeRobot, FakeTable

from thinkgrasp.errors import ConfigError, InputError
from thinkgrasp.loop import END_WORDS, End, Fusion, run_episode
from thinkgrasp.memory import Memory
from thinkgrasp.types import Frame, Grasps, Plan, Scene, Usage


class PatientPlanner(FakePlanner):
    """As the fake planner, but takes the other block while the wanted one is left for later."""

    def plan(self, scene: Scene, instruction: str, memory: Memory) -> Plan:
        for p in sorted(scene.proposals, key=lambda p: p.colors[0][0] not in instruction):
            if not memory.is_worn_out(p):
                role = "goal" if p.colors[0][0] in instruction else "obstruction"
                return Plan(p.colors[0][0], "next", role=role, mark=p.mark)
        return Plan("", "nothing is left", found=False)


class NoneOnTheLeft:
    def keep(self, scene, target, grasps: Grasps, gripper) -> np.ndarray:
        return grasps.positions[:, 0] > 0


def run(table: FakeTable, instruction: str = "the red block", script=(), pipeline=None, **options):
    robot = FakeRobot(table, script)
    episode = run_episode([FakeCamera(table)], pipeline or fake_pipeline(), robot, instruction, **options)
    return episode, robot


def test_a_goal_at_hand_is_delivered_in_one_step() -> None:
    episode, robot = run(FakeTable())
    assert (episode.success, episode.end, episode.attempts, len(robot.grasps)) == (True, "goal_delivered", 1, 1)


def test_after_a_miss_another_grasp_is_tried() -> None:
    episode, robot = run(FakeTable(), script=["missed", "missed"])
    assert [s.outcome.reason for s in episode.steps] == ["missed", "missed", "held"]  # type: ignore[union-attr]
    first, second, third = (g.position for g in robot.grasps)
    assert min(np.linalg.norm(first - second), np.linalg.norm(second - third), np.linalg.norm(first - third)) > 0.012
    checks = [f.check for f in episode.steps[1].decision.funnel]
    assert "not_failed_before" in checks


def test_after_three_failures_a_thing_is_left_until_another_was_removed() -> None:
    pipeline = fake_pipeline(planner=PatientPlanner())
    episode, _ = run(FakeTable(), script=["missed"] * 3, pipeline=pipeline)
    taken = [s.decision.plan.target for s in episode.steps]
    assert taken == ["red", "red", "red", "blue", "red"]
    assert episode.success


def test_a_thing_without_a_grasp_is_put_aside_in_the_same_step() -> None:
    pipeline = fake_pipeline(planner=PatientPlanner(), checks={"right": NoneOnTheLeft()})
    episode, _ = run(FakeTable(), pipeline=pipeline)
    assert [s.decision.plan.target for s in episode.steps] == ["blue", "red"]
    assert (episode.end, episode.steps[-1].outcome) == ("no_grasp", None)


def test_what_is_still_seen_where_it_was_was_not_removed() -> None:
    episode, _ = run(FakeTable(), script=["lies"])
    assert [s.outcome.reason for s in episode.steps] == ["still_there", "held"]  # type: ignore[union-attr]
    assert episode.success


def test_the_referee_decides_where_there_is_one() -> None:
    table = FakeTable()
    episode, _ = run(
        table, "the red block, then blue", pipeline=fake_pipeline(planner=PatientPlanner()),
        referee=lambda decision, outcome: "blue" not in table.there,
    )  # fmt: skip
    assert episode.success
    assert [s.decision.plan.target for s in episode.steps] == ["red", "blue"]


@pytest.mark.parametrize(
    ("instruction", "script", "options", "end", "steps"),
    [
        ("the green block", [], {}, "nothing_left", 1),
        ("the red block", ["missed"] * 9, {"step_limit": 2}, "step_limit", 2),
        ("the red block", [], {"stop": lambda: True}, "stopped", 0),
        ("the red block", [], {"pipeline": fake_pipeline(checks={"none": FakeCheck(2.0)})}, "no_grasp", 1),
    ],
)
def test_every_end_has_its_reason(instruction: str, script: list[str], options: dict, end: End, steps: int) -> None:
    episode, _ = run(FakeTable(), instruction, script, **options)
    assert (episode.end, len(episode.steps), episode.success) == (end, steps, False)
    assert END_WORDS[end]


class SpendingPlanner(FakePlanner):
    """Asks a model of known price for every plan, and has money for two."""

    asked = 0

    def plan(self, scene: Scene, instruction: str, memory: Memory) -> Plan:
        self.asked += 1
        if self.asked > 2:
            return Plan("", "the budget is spent", found=False, out_of_budget=True)
        return replace(super().plan(scene, instruction, memory), usage=Usage("gpt-4o", 100, 10, 0.5, 1, 2.0))


def test_a_spent_budget_ends_the_episode() -> None:
    planner = SpendingPlanner()
    table = FakeTable()
    cameras = [FakeCamera(table), FakeCamera(table, POSE)]
    robot = FakeRobot(table, ["missed"] * 9)
    episode = run_episode(cameras, fake_pipeline(planner=planner), robot, "the red block")
    assert (episode.end, episode.attempts, planner.asked) == ("budget_spent", 2, 3)
    assert cameras[1].reads == 0
    assert episode.usage == Usage("gpt-4o", 200, 20, 1.0, 2, 4.0)


def test_a_budget_spent_at_the_second_camera_ends_the_episode_too() -> None:
    planner = SpendingPlanner()
    planner.asked = 1
    table = FakeTable()
    cameras = [FakeCamera(table), FakeCamera(table, POSE)]
    episode = run_episode(cameras, fake_pipeline(planner=planner), FakeRobot(table), "the green block")
    assert (episode.end, planner.asked) == ("budget_spent", 3)


def test_decisions_that_are_not_acted_upon_cost_too() -> None:
    planner = SpendingPlanner()
    episode, _ = run(FakeTable(), pipeline=fake_pipeline(planner=planner, checks={"none": FakeCheck(2.0)}))
    assert (episode.attempts, episode.usage.requests) == (0, 2)


def test_the_second_camera_is_asked_where_the_first_shows_no_grasp() -> None:
    class OnlyFromAside:
        def keep(self, scene, target, grasps: Grasps, gripper) -> np.ndarray:
            return np.full(len(grasps), scene.frame.T_world_camera[0, 3] > 0)

    table = FakeTable()
    aside = POSE.copy()
    aside[0, 3] = 0.05
    cameras = [FakeCamera(table), FakeCamera(table, aside)]
    robot = FakeRobot(table)
    pipeline = fake_pipeline(checks={"aside": OnlyFromAside()})
    episode = run_episode(cameras, pipeline, robot, "the red block")
    assert episode.success
    frame = episode.steps[0].decision.scene.frame
    assert frame.T_world_camera is not None
    assert frame.T_world_camera[0, 3] == pytest.approx(0.05)
    assert cameras[1].reads == 1


class OnlyOnSeveralViews:
    """Keeps grasps on a fused frame alone, or on a view from aside alone."""

    def __init__(self, *, aside: bool = False) -> None:
        self.aside, self.asked = aside, list[str]()

    def keep(self, scene, target, grasps: Grasps, gripper) -> np.ndarray:
        is_fused, is_aside = scene.frame.others is not None, scene.frame.T_world_camera[0, 3] > 0
        self.asked.append("fused" if is_fused else "aside" if is_aside else "first")
        return np.full(len(grasps), is_aside if self.aside else is_fused)


def two_cameras(table: FakeTable) -> list[FakeCamera]:
    aside = POSE.copy()
    aside[0, 3] = 0.05
    return [FakeCamera(table), FakeCamera(table, aside)]


@pytest.mark.parametrize(
    ("fusion", "asked"),
    [("first", ["first", "fused"]), ("last", ["first", "aside", "fused"]), ("always", ["fused"])],
)
def test_all_views_are_fused_where_one_shows_no_grasp(fusion: Fusion, asked: list[str]) -> None:
    table, check = FakeTable(), OnlyOnSeveralViews()
    cameras = two_cameras(table)
    pipeline = fake_pipeline(checks={"several": check})
    episode = run_episode(cameras, pipeline, FakeRobot(table), "the red block", fusion=fusion)
    assert episode.success
    assert list(dict.fromkeys(check.asked)) == asked
    frame = episode.steps[0].decision.scene.frame
    assert frame.others is not None
    assert frame.T_world_camera is not None
    assert frame.T_world_camera[0, 3] == 0
    assert cameras[1].reads == 1


def test_a_thing_without_a_grasp_on_any_view_alone_is_asked_for_once_more_on_all() -> None:
    """What one view after the other had to give up is not given up by the fused one before it was tried."""
    table = FakeTable()
    pipeline = fake_pipeline(planner=PatientPlanner(), checks={"several": OnlyOnSeveralViews()})
    episode = run_episode(two_cameras(table), pipeline, FakeRobot(table), "the red block")
    assert [s.decision.plan.target for s in episode.steps] == ["red"]
    assert episode.success


@pytest.mark.parametrize("fusion", ["first", "last"])
def test_what_the_first_view_does_not_show_is_not_asked_for_on_the_fused_one(fusion: Fusion) -> None:
    planner = SpendingPlanner()
    planner.asked = -9
    table = FakeTable()
    pipeline = fake_pipeline(planner=planner)
    episode = run_episode(two_cameras(table), pipeline, FakeRobot(table), "the green block", fusion=fusion)
    assert (episode.end, planner.asked) == ("nothing_left", -9 + 2)


def test_without_fusion_the_other_views_are_looked_at_alone() -> None:
    table, check = FakeTable(), OnlyOnSeveralViews()
    pipeline = fake_pipeline(checks={"several": check})
    episode = run_episode(two_cameras(table), pipeline, FakeRobot(table), "the red block", fusion="never")
    assert (episode.end, set(check.asked)) == ("no_grasp", {"first", "aside"})


@pytest.mark.parametrize("fusion", ["first", "last"])
def test_where_fused_views_show_no_grasp_another_view_alone_may(fusion: Fusion) -> None:
    table, check = FakeTable(), OnlyOnSeveralViews(aside=True)
    pipeline = fake_pipeline(checks={"aside": check})
    episode = run_episode(two_cameras(table), pipeline, FakeRobot(table), "the red block", fusion=fusion)
    assert episode.success
    assert episode.steps[0].decision.scene.frame.others is None


def test_what_is_removed_by_a_fused_view_is_verified_in_the_first() -> None:
    table = FakeTable()
    pipeline = fake_pipeline(checks={"several": OnlyOnSeveralViews()})
    episode = run_episode(two_cameras(table), pipeline, FakeRobot(table, ["lies"]), "the red block")
    assert [s.outcome.reason for s in episode.steps] == ["still_there", "held"]  # type: ignore[union-attr]


def test_cameras_without_poses_are_not_fused_and_that_is_said() -> None:
    class Nowhere(FakeCamera):
        def read(self) -> Frame:
            return replace(super().read(), T_world_camera=None)

    class AsideOnly:
        calls = 0

        def keep(self, scene, target, grasps: Grasps, gripper) -> np.ndarray:
            self.calls += 1
            return np.full(len(grasps), self.calls > 2)  # twice on the first: its two segments' turn and the report's

    table = FakeTable()
    pipeline = fake_pipeline(checks={"aside": AsideOnly()})
    episode = run_episode([Nowhere(table), Nowhere(table)], pipeline, FakeRobot(table), "the red block")
    decision = episode.steps[0].decision
    assert decision.grasp is not None
    assert [(d.stage, d.fallback) for d in decision.degraded] == [("fusion", "each view was looked at alone")]


def test_every_step_is_recorded_when_it_is_finished() -> None:
    recorder = FakeRecorder()
    episode, _ = run(FakeTable(), script=["missed"], recorders=[recorder])
    assert recorder.steps == [("grasp", "missed"), ("grasp", "held")]
    assert len(episode.steps) == 2


def test_bad_input() -> None:
    table = FakeTable()
    with pytest.raises(ConfigError, match="at least one step"):
        run(table, step_limit=0)
    with pytest.raises(ConfigError, match="a camera"):
        run_episode([], fake_pipeline(), FakeRobot(table), "the red block")
    with pytest.raises(ConfigError, match="no fusion 'sometimes'; allowed: never, first, last, always"):
        run(table, fusion="sometimes")
    with pytest.raises(InputError, match="empty"):
        run(table, " ")
